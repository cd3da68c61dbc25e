/// How far the lights moved in an iteration, and how much of the next step is taken.
#pragma once
#include <Eigen/Dense>

#include "optimize/light_solve.h"

namespace chiaro::optimize {

/// How far the lights moved: ln flash, sky relative to the flash, its colour, bounce, the floor's albedo, all of the order of one.
using LightStep = Eigen::Matrix<double, kSkyTerms + 5, 1>;
LightStep light_step(const Lights& from, const Lights& to);

/// Sum of the relative changes: small when an iteration is over.
double light_change(const Lights& a, const Lights& b);

/// Share of the new state that the next iteration starts from, by how the last step answered the one before: a step that turns back asks for less.
/// source: Irons & Tuck, "A version of the Aitken accelerator for computer iteration", Int. J. Numer. Meth. Engng 1, 1969, in its vector form.
class Relaxation {
 public:
  double share() const { return share_; }
  void observe(const LightStep& step);

 private:
  static constexpr double kLeast = 0.2;
  LightStep last_ = LightStep::Zero();
  double share_ = 1;
};

}  // namespace chiaro::optimize
