/// The state of a finished blend, kept so that a later one with photographs added or taken away begins from it.
///
/// A blend from the beginning is a function of its photographs; one that goes on from here has to give the same bits. So nothing is taken over that the
/// change may touch: votes are added and withdrawn one by one, a ballot that was full when it lost a vote is collected anew, and the sums of a leaf stay
/// only where its votes, the factors and places of all photographs that may see it, and the tolerance are what they were.
#pragma once
#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "blend/accumulate.h"
#include "blend/ballot.h"
#include "blend/inspect.h"
#include "blend/leaf_file.h"

namespace chiaro::blend {

/// What was found out about one photograph.
struct PhotographState {
  std::string key;               ///< photograph_key()
  Vec3f log_gain = Vec3f::Zero();
  ReadingDistances distances;    ///< of those that were in the sample; of others no readings
  Inspection inspection;
  Alignment alignment;
};

struct BlendState {
  std::string options_key, votes_key, sums_key;
  float footprint = 0, brightness = 0;
  Tolerance tolerance;
  bool inspected = false;
  std::vector<PhotographState> photographs;   ///< in the order in which they were added
};

class KeptBlend {
 public:
  /// nullopt where there is none, or it is damaged, of other options, or of photographs in another order.
  /// surfels_of_leaf: of the store; photograph_keys: of the blend at hand, in its order.
  static std::optional<KeptBlend> open(const std::filesystem::path& folder, const std::string& options_key, std::span<const std::string> photograph_keys,
                                       const std::vector<std::uint32_t>& surfels_of_leaf, std::uint32_t middle_bands);
  /// Takes over the files of a finished blend. throws Error.
  static void save(const std::filesystem::path& folder, const BlendState& state, const std::filesystem::path& votes, const std::filesystem::path& sums);

  const BlendState& state() const { return state_; }
  /// Of photograph k of the blend at hand: what was known of it; null if it is new.
  const PhotographState* photograph(std::uint32_t k) const { return then_of_now_[k] == kNone ? nullptr : &state_.photographs[then_of_now_[k]]; }

  /// Votes of a leaf by photographs of the blend at hand; those of photographs that are gone are withdrawn.
  struct Votes {
    LeafRecord<Ballot> record;
    bool is_written = false;
    bool withdrawn = false;      ///< some were
    bool is_whole = true;        ///< no ballot may have lost a vote to one that is gone
  };
  Votes votes(std::size_t leaf) const;

  struct Sums {
    LeafRecord<Accumulator> record;
    bool is_written = false;
    bool holds_removed = false;  ///< readings of photographs that are gone are in them
  };
  Sums sums(std::size_t leaf) const;

 private:
  static constexpr std::uint32_t kNone = 0xffffffffu;
  KeptBlend(BlendState state, LeafFile votes, LeafFile sums) : state_(std::move(state)), votes_(std::move(votes)), sums_(std::move(sums)) {}
  BlendState state_;
  LeafFile votes_, sums_;
  std::vector<std::uint32_t> now_of_then_, then_of_now_;
};

/// Numbers in `now` of the keys of `then`, kNone (0xffffffff) where one is gone; nullopt if those that stay have changed their order.
std::optional<std::vector<std::uint32_t>> numbers_now(std::span<const PhotographState> then, std::span<const std::string> now);

}  // namespace chiaro::blend
