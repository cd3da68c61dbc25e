#include "tools/cloud_units.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <sstream>

#include "stream/base/file.h"
#include "tests/support/files.h"

namespace chiaro::tools {
namespace {

using chiaro::test::put_bytes;
using testing::AllOf;
using testing::HasSubstr;

class CloudUnits : public testing::Test {
 protected:
  /// Corners of a cube of size 2 about `middle`, all times `factor`.
  std::filesystem::path cube(const std::string& name, double factor, double middle = 0.5) const {
    std::ostringstream text;
    for (int i = 0; i < 8; ++i) text << factor * (middle + (i & 1 ? 1 : -1)) << ' ' << factor * (middle + (i & 2 ? 1 : -1)) << ' ' << factor * (i & 4 ? 2 : 0) << '\n';
    put_bytes(scratch_.path() / name, text.str());
    return scratch_.path() / name;
  }
  ScratchFolder scratch_;
};

TEST_F(CloudUnits, MillimetresBesideMetresAreNamedInEitherOrder) {
  const auto metres = cube("m.xyz", 1), millimetres = cube("mm.xyz", 1000, 0.9);
  for (const auto& files : {std::vector{metres, millimetres}, std::vector{millimetres, metres}}) {
    const auto notes = notes_on_units(files, 1 << 20);
    ASSERT_EQ(notes.size(), 1u);
    EXPECT_THAT(notes[0], AllOf(HasSubstr("mm.xyz has coordinates 1000 times as large as those of m.xyz"), HasSubstr("is it in millimetres")));
  }
}

TEST_F(CloudUnits, CentimetresAreNamed) { EXPECT_THAT(notes_on_units({cube("m.xyz", 1), cube("cm.xyz", 100)}, 1 << 20), testing::ElementsAre(HasSubstr("is it in centimetres"))); }

TEST_F(CloudUnits, ScansOfOneUnitAreNot) {
  EXPECT_TRUE(notes_on_units({cube("a.xyz", 1), cube("b.xyz", 1, 3)}, 1 << 20).empty());
  EXPECT_TRUE(notes_on_units({cube("a.xyz", 1)}, 1 << 20).empty());
}

/// A building, and a detail of it a thousandth as large that lies where it belongs.
TEST_F(CloudUnits, ADetailIsNotTakenForAnotherUnit) { EXPECT_TRUE(notes_on_units({cube("building.xyz", 20), cube("detail.xyz", 0.02, 500)}, 1 << 20).empty()); }

}  // namespace
}  // namespace chiaro::tools
