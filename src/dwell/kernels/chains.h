// Chains: the cycles from which jobs descend, and the ages of actuations.
#pragma once

#include <limits>

#include "samples.h"

namespace dwell {

// Descent of a job from no cycle of a chain's first task.
constexpr i32 kNoOrigin = std::numeric_limits<i32>::max();
constexpr Descent kNoDescent{kNoOrigin, -1};

// Finds the cycles from which a job descends, per chain, when a worker takes the job.
template <class S>
void descend(S& s, i64 key) {
  const i64 cell = cell_of(key), cycle = cycle_of(key), task = item_of(key);
  const Cell& of = s.cell(cell);
  const Task& to = s.task(cell, task);
  for (i64 chain = 0; chain < of.n_chains; ++chain) {
    Descent& descent = s.descent(cell, cycle, task, chain);
    if (s.chains[of.chain_0 + chain].source == task) {
      descent = {static_cast<i32>(cycle), static_cast<i32>(cycle)};
      continue;
    }
    descent = kNoDescent;
    for (i64 flow = to.in_0; flow < to.in_0 + to.n_inputs; ++flow) {
      const Flow& ends = s.flow(cell, flow);
      const i64 from = ends.is_sampled ? value_of(s, s.job(key).site, flow) : cycle;
      if (from == kNoValue) continue;
      const Descent& sent = s.descent(cell, from, ends.source, chain);
      descent = {std::min(descent.oldest, sent.oldest), std::max(descent.newest, sent.newest)};
    }
  }
}

// Records the completion of the last task of chains.
template <class S>
void actuate(S& s, i64 cell, i64 cycle, i64 task, i64 now) {
  const Cell& of = s.cell(cell);
  for (i64 number = 0; number < of.n_chains; ++number) {
    Chain& chain = s.chains[of.chain_0 + number];
    if (chain.target != task) continue;
    const Descent& descent = s.descent(cell, cycle, task, number);
    if (descent.oldest != kNoOrigin) chain.last = descent.oldest;
    const i64 row = s.actuation(cell, number, cycle);
    s.actuated_ns[row] = now;
    s.actuated_from[row] = chain.last;
    s.actuated_newest[row] = descent.newest;
  }
}

// Whether a chain's age at the actuation of a cycle, as known now, is over its bound.
template <class S>
bool is_over_age(const S& s, i64 cell, i64 cycle, i64 now) {
  const Cell& of = s.cell(cell);
  for (i64 number = 0; number < of.n_chains; ++number) {
    const i64 row = s.actuation(cell, number, cycle), at_ns = s.actuated_ns[row];
    const i64 max_age_ns = s.chains[of.chain_0 + number].max_age_ns;
    if (at_ns <= now && at_ns - of.release_ns[s.actuated_from[row]] > max_age_ns) return true;
  }
  return false;
}

}  // namespace dwell
