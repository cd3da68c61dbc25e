/// A folder in which photographs are developed.
#pragma once
#include "stream/photo/develop.h"
#include "stream/photo/raster.h"
#include "tests/stream/photo/photo_support.h"

namespace chiaro::stream {

class DevelopFixture : public testing::Test {
 protected:
  DevelopResult run(const std::filesystem::path& photograph, const DevelopOptions& options) { return develop(photograph, options, raster_path(), silent_reporter()); }
  std::filesystem::path raster_path() const { return scratch_.path() / "out.raster"; }
  RasterReader raster() const { return RasterReader(raster_path()); }
  std::filesystem::path path(const std::string& name) const { return scratch_.path() / name; }
  ScratchFolder scratch_;
};

}  // namespace chiaro::stream
