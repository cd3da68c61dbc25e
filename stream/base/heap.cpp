#include "stream/base/heap.h"

#include <cstdlib>

#ifdef __GLIBC__
#include <malloc.h>
#endif

namespace chiaro {

void return_freed_memory() {
#ifdef __GLIBC__
  malloc_trim(0);   // all arenas, whole pages in the middle of the heap too
#endif
}

}  // namespace chiaro
