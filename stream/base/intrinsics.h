/// The processor's vector instructions, where there are any, without the warnings that GCC 12 has for its own header.
#pragma once
#if defined(__x86_64__)
#if defined(__clang__)
#include <immintrin.h>
#else  // GCC 12 warns of its own intrinsics
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wuninitialized"
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#include <immintrin.h>
#pragma GCC diagnostic pop
#endif
#endif
