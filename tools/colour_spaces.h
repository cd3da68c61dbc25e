/// Colours of linear RGB with sRGB primaries in spaces that follow the eye, and how different two of them look.
#pragma once
#include <array>

namespace chiaro::tools {

using Triple = std::array<double, 3>;

/// A linear opponent space: like Lab, without the cube root.
Triple ycxcz(const Triple& rgb);
Triple rgb_from_ycxcz(const Triple& ycc);

/// CIE L*a*b* (D65 white) of linear RGB with sRGB primaries.
Triple lab_from_linear(const Triple& rgb);

/// Colour difference of two Lab colours with kL = kC = kH = 1.
/// source  Sharma, Wu, Dalal, "The CIEDE2000 color-difference formula: implementation notes, supplementary test data, …", 2005.
double delta_e_2000(const Triple& lab_1, const Triple& lab_2);

}  // namespace chiaro::tools
