/// Facts of the LAS format shared by reader and writer. source: ASPRS, "LAS Specification 1.4 - R15". Internal to stream/cloud.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>

#include "stream/cloud/point_stream.h"

namespace chiaro::stream::las {

/// Byte offsets in the public header block.
enum HeaderOffset : std::size_t {
  kGlobalEncoding = 6,
  kVersionMajor = 24,
  kVersionMinor = 25,
  kSystemId = 26,
  kSoftware = 58,
  kHeaderSize = 94,
  kPointOffset = 96,
  kNumVlrs = 100,
  kPointFormat = 104,
  kRecordLength = 105,
  kLegacyCount = 107,
  kScale = 131,
  kAdd = 155,
  kBounds = 179 /* max x, min x, max y, ... */,
  kCount = 247,
  kCountByReturn = 255
};
inline constexpr std::size_t kHeaderBytes12 = 227, kHeaderBytes13 = 235, kHeaderBytes14 = 375;
inline constexpr std::size_t kVlrHeaderBytes = 54, kExtraBytesBytes = 192;
inline constexpr std::uint16_t kExtraBytesRecord = 4;   ///< record id of the Extra Bytes VLR of user "LASF_Spec"
inline constexpr std::uint16_t kWktRecord = 2112;      ///< record id of the VLR of user "LASF_Projection" with the coordinate system as WKT
inline constexpr std::uint16_t kLaszipRecord = 22204;  ///< record id of the VLR of user "laszip encoded"
inline constexpr unsigned kCompressedBit = 0x80;       ///< in the point format's byte: LAZ

/// Bytes of a point record without extra bytes, by point format 0..10.
inline constexpr std::array<std::uint16_t, 11> kRecordBytes = {20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67};
/// Where RGB, GPS time, near infrared and the wave packet start in each format; 0 = not there.
inline constexpr std::array<std::uint8_t, 11> kColourAt = {0, 0, 20, 28, 0, 28, 0, 30, 30, 0, 30};
inline constexpr std::array<std::uint8_t, 11> kTimeAt = {0, 20, 0, 20, 20, 20, 22, 22, 22, 22, 22};
inline constexpr std::array<std::uint8_t, 11> kInfraredAt = {0, 0, 0, 0, 0, 0, 0, 0, 36, 0, 36};
inline constexpr std::array<std::uint8_t, 11> kWaveAt = {0, 0, 0, 0, 28, 34, 0, 0, 0, 30, 38};

/// A value in the fixed part of a record, by its name among our extras. mask 0: the whole scalar.
struct CoreField {
  const char* name;
  ScalarType type;
  std::uint8_t offset, shift, mask;
};

inline constexpr std::array<CoreField, 9> kLegacyFields = {{{"intensity", ScalarType::kU16, 12, 0, 0},
                                                            {"return_number", ScalarType::kU8, 14, 0, 7},
                                                            {"number_of_returns", ScalarType::kU8, 14, 3, 7},
                                                            {"scan_direction", ScalarType::kU8, 14, 6, 1},
                                                            {"edge_of_flight_line", ScalarType::kU8, 14, 7, 1},
                                                            {"classification", ScalarType::kU8, 15, 0, 31},
                                                            {"classification_flags", ScalarType::kU8, 15, 5, 7},
                                                            {"scan_angle_rank", ScalarType::kI8, 16, 0, 0},
                                                            {"user_data", ScalarType::kU8, 17, 0, 0}}};
inline constexpr CoreField kLegacySource = {"point_source_id", ScalarType::kU16, 18, 0, 0};

/// Point formats 6 to 10.
inline constexpr std::array<CoreField, 11> kFields = {{{"intensity", ScalarType::kU16, 12, 0, 0},
                                                       {"return_number", ScalarType::kU8, 14, 0, 15},
                                                       {"number_of_returns", ScalarType::kU8, 14, 4, 15},
                                                       {"classification_flags", ScalarType::kU8, 15, 0, 15},
                                                       {"scanner_channel", ScalarType::kU8, 15, 4, 3},
                                                       {"scan_direction", ScalarType::kU8, 15, 6, 1},
                                                       {"edge_of_flight_line", ScalarType::kU8, 15, 7, 1},
                                                       {"classification", ScalarType::kU8, 16, 0, 0},
                                                       {"user_data", ScalarType::kU8, 17, 0, 0},
                                                       {"scan_angle", ScalarType::kI16, 18, 0, 0},
                                                       {"point_source_id", ScalarType::kU16, 20, 0, 0}}};

}  // namespace chiaro::stream::las
