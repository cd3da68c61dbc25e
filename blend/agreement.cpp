#include "blend/agreement.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <tuple>
#include <utility>

namespace chiaro::blend {
namespace {

template <class T>
T median(std::vector<T> values) {
  if (values.empty()) return 0;
  const std::size_t half = values.size() / 2;
  std::nth_element(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(half), values.end());
  if (values.size() % 2 == 1) return values[half];
  return T(0.5) * (values[half] + *std::max_element(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(half)));
}

/// One unknown a photograph: x_a - x_b = difference.
struct Equation {
  std::uint16_t a = 0, b = 0;
  float difference = 0;
};

/// Photographs that overlap directly or through others carry the same number.
std::vector<std::size_t> groups_of(const std::vector<Equation>& equations, std::size_t count) {
  std::vector<std::size_t> parent(count);
  std::iota(parent.begin(), parent.end(), std::size_t{0});
  const auto root = [&](std::size_t i) {
    while (parent[i] != i) i = parent[i] = parent[parent[i]];
    return i;
  };
  for (const Equation& e : equations) parent[root(e.a)] = root(e.b);
  for (std::size_t i = 0; i < count; ++i) parent[i] = root(i);
  return parent;
}

/// All equations between two photographs, weighted: weight (x_a - x_b) = right.
struct Edge {
  std::uint16_t a = 0, b = 0;
  double weight = 0;
};

/// Solves (diagonal - edges) x = right by conjugate gradients, from the x given: as much memory as there are edges, where a factorisation would take a number for
/// every two photographs. Each step divides what is left by more where photographs overlap with many; along a chain there are as many steps as photographs, of few edges.
void solve(const std::vector<Edge>& edges, const Eigen::VectorXd& diagonal, const Eigen::VectorXd& right, Eigen::VectorXd& x) {
  constexpr double kLeft = 1e-12;   // of the right side, in squares
  const auto product = [&](const Eigen::VectorXd& v) {
    Eigen::VectorXd result = diagonal.cwiseProduct(v);
    for (const Edge& e : edges) {
      result[e.a] -= e.weight * v[e.b];
      result[e.b] -= e.weight * v[e.a];
    }
    return result;
  };
  Eigen::VectorXd residual = right - product(x), direction = residual.cwiseQuotient(diagonal);
  const double enough = kLeft * right.dot(right.cwiseQuotient(diagonal));
  double left = residual.dot(direction);
  for (Eigen::Index step = 0; step < 4 * x.size() && left > enough; ++step) {
    const Eigen::VectorXd image = product(direction);
    const double length = left / direction.dot(image);
    x += length * direction;
    residual -= length * image;
    const Eigen::VectorXd next = residual.cwiseQuotient(diagonal);
    const double left_now = residual.dot(next);
    direction = next + left_now / left * direction;
    left = left_now;
  }
}

/// Least absolute differences of x_a - x_b = difference, by reweighted least squares. It is convex: where it starts does not matter. Sorts the equations.
std::vector<double> least_absolute(std::vector<Equation>& equations, std::size_t count) {
  constexpr int kRounds = 40;
  constexpr double kFlat = 2e-3, kRidge = 1e-6;   // differences below kFlat count as squares; the ridge holds what the equations leave open
  Eigen::VectorXd x = Eigen::VectorXd::Zero(static_cast<Eigen::Index>(count));
  std::sort(equations.begin(), equations.end(), [](const Equation& p, const Equation& q) { return std::tie(p.a, p.b, p.difference) < std::tie(q.a, q.b, q.difference); });
  std::vector<Edge> edges;
  for (int round = 0; round < kRounds && !equations.empty(); ++round) {
    edges.clear();
    Eigen::VectorXd diagonal = Eigen::VectorXd::Constant(x.size(), kRidge), right = Eigen::VectorXd::Zero(x.size());
    for (const Equation& e : equations) {
      const double w = 1 / std::max(kFlat, std::abs(x[e.a] - x[e.b] - static_cast<double>(e.difference)));
      if (edges.empty() || edges.back().a != e.a || edges.back().b != e.b) edges.push_back({e.a, e.b, 0});
      edges.back().weight += w;
      diagonal[e.a] += w;
      diagonal[e.b] += w;
      right[e.a] += w * static_cast<double>(e.difference);
      right[e.b] -= w * static_cast<double>(e.difference);
    }
    const Eigen::VectorXd before = x;
    solve(edges, diagonal, right, x);
    if ((x - before).cwiseAbs().maxCoeff() < 1e-6) break;
  }
  return {x.data(), x.data() + x.size()};
}

/// The middle photograph of each group keeps its brightness.
void centre(std::vector<double>& x, const std::vector<Equation>& equations) {
  const std::vector<std::size_t> group = groups_of(equations, x.size());
  std::vector<std::vector<double>> members(x.size());   // by group
  for (std::size_t i = 0; i < x.size(); ++i) members[group[i]].push_back(x[i]);
  std::vector<double> middle(x.size());
  for (std::size_t g = 0; g < x.size(); ++g) middle[g] = median(std::move(members[g]));
  for (std::size_t i = 0; i < x.size(); ++i) x[i] -= middle[group[i]];
}

/// channel < 0: the mean of the three.
std::vector<double> gains_of(std::span<const ReadingPair> pairs, std::size_t count, int channel) {
  std::vector<Equation> equations;
  equations.reserve(pairs.size());
  for (const ReadingPair& p : pairs) equations.push_back({p.a, p.b, channel < 0 ? p.difference.mean() : p.difference[channel]});
  std::vector<double> x = least_absolute(equations, count);
  centre(x, equations);
  return x;
}

float scatter_of(std::span<const ReadingPair> pairs, const std::vector<Vec3f>& log_gain) {
  std::vector<float> distances;
  distances.reserve(pairs.size());
  for (const ReadingPair& p : pairs) distances.push_back((p.difference + log_gain[p.b] - log_gain[p.a]).cwiseAbs().maxCoeff());
  return median(std::move(distances));
}

/// Smaller factors stay: they are as likely errors of geometry and light that a whole photograph has in common, and the low band smooths their seams.
/// Rounded, so that one photograph more or less seldom changes what is known of the others: what hangs on it need not be done again.
constexpr float kGainSteps = 1024, kToleranceStepsPerOctave = 8;
constexpr float kLeastGain = 0.02f, kLeastGainScatters = 1.5f;

}  // namespace

void append_pairs(const Ballot& ballot, std::vector<ReadingPair>& pairs) {
  const float darkest = std::log(6 * kDarkOffset);
  std::array<Vec3f, kVotes> logs;
  std::array<bool, kVotes> is_bright{};
  for (std::size_t j = 0; j < kVotes; ++j) {
    if (ballot.votes[j].weight == 0) continue;
    logs[j] = log_low_of(ballot.votes[j]);
    if (!(logs[j].minCoeff() > darkest)) continue;
    logs[j] = (logs[j].array().exp() - kDarkOffset).log();   // a factor is a factor only without the offset
    for (std::size_t i = 0; i < j; ++i)
      if (is_bright[i]) pairs.push_back({ballot.votes[i].photograph, ballot.votes[j].photograph, logs[j] - logs[i]});
    is_bright[j] = true;
  }
}

Agreement find_agreement(std::span<const ReadingPair> pairs, std::size_t num_photographs, Gain gain) {
  Agreement result;
  result.log_gain.assign(num_photographs, Vec3f::Zero());
  result.pairs = pairs.size();
  const int solutions = gain == Gain::kNone ? 0 : gain == Gain::kGrey ? 1 : 3;
  for (int c = 0; c < solutions; ++c) {
    const std::vector<double> x = gains_of(pairs, num_photographs, solutions == 1 ? -1 : c);
    for (std::size_t k = 0; k < num_photographs; ++k) {
      if (solutions == 1) result.log_gain[k].setConstant(static_cast<float>(x[k]));
      else result.log_gain[k][c] = static_cast<float>(x[k]);
    }
  }
  result.scatter = scatter_of(pairs, result.log_gain);
  const float least = std::max(kLeastGain, kLeastGainScatters * result.scatter);
  for (Vec3f& one : result.log_gain) {
    if (one.cwiseAbs().maxCoeff() < least) one.setZero();
    else one = (one.array() * kGainSteps).round() / kGainSteps;
  }
  return result;
}

float tolerance_for(float scatter) {
  // Eight times the median of differences is 5 sd of normal ones; shadows and relief have longer tails, and 6 gave away good readings (measured on a rendered
  // tower: error 3.254 -> 3.247 %). 3 % are within what interpolation and blur make of edges.
  constexpr float kScatters = 8, kLeast = 0.03f;
  if (!(kScatters * scatter > kLeast)) return kLeast;
  return kLeast * std::exp2(std::ceil(std::log2(kScatters * scatter / kLeast) * kToleranceStepsPerOctave) / kToleranceStepsPerOctave);
}

namespace {

struct Middle {
  float distance = 0;
  std::uint64_t readings = 0;   // of all photographs
};
Middle middle_of(std::span<const ReadingDistances> photographs, std::size_t c) {
  std::vector<std::pair<float, std::uint64_t>> medians;
  Middle middle;
  for (const ReadingDistances& p : photographs) {
    medians.emplace_back(p.median[c], p.readings[c]);
    middle.readings += p.readings[c];
  }
  std::sort(medians.begin(), medians.end());
  std::uint64_t below = 0;
  for (const auto& [distance, readings] : medians) {
    below += readings;
    middle.distance = distance;
    if (2 * below >= middle.readings) break;
  }
  return middle;
}

}  // namespace

Tolerance tolerance_by_class(float of_votes, std::span<const ReadingDistances> photographs) {
  // Of readings that have no vote the tails are shorter than those of pairs of votes, as they hold more of what is usual: 99 of 100 lie within 3 medians where they weigh
  // least, within 9 just below the votes (statue, 60 photographs). A contradiction begins at one and a half times what is allowed.
  constexpr float kMedians = 4;
  constexpr std::uint64_t kLeastReadings = 200;
  Tolerance tolerance;
  tolerance.by_class[0] = of_votes;
  for (std::size_t c = 1; c < Tolerance::kClasses; ++c) {
    float& allowed = tolerance.by_class[c];
    allowed = tolerance.by_class[c - 1];
    const Middle middle = middle_of(photographs, c);
    const float wanted = kMedians * middle.distance;
    if (middle.readings < kLeastReadings || !(wanted > allowed)) continue;
    allowed = of_votes * std::exp2(std::ceil(2 * std::log2(wanted / of_votes)) / 2);   // steps of half an octave, as they seldom change with one photograph more
  }
  return tolerance;
}

}  // namespace chiaro::blend
