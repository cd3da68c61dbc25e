// LAZ and E57 in a build that found no cargo.
#include "stream/cloud/formats.h"
#include "stream/cloud/laz_rows.h"

namespace chiaro::stream {

std::unique_ptr<PointReader> read_laz_rows(File file, RowDecoder, LazRows) { throw missing_rust_formats(file.path(), "LAZ"); }

std::unique_ptr<PointReader> open_e57(File file) { throw missing_rust_formats(file.path(), "E57"); }

}  // namespace chiaro::stream
