// Decisions of built-in policies with the estimator `profile` at the end of a window.
//
// A second implementation of classes of dwell.policies and dwell.estimators.profile. These classes
// are the reference; the results here equal theirs bit for bit. The simulation has a single cell.
// Bounds of the model keep every J finite.
#pragma once

#include "rows.h"

namespace dwell {

// Decides after a window, or on the cycles that a decision looks at; returns false if the decision
// is a move, which the caller carries out.
bool decide(const Tables& s, i64 decision);

// Assigns the incumbent to the cycles that may be released before the next decision.
void stamp_next(const Tables& s);

}  // namespace dwell
