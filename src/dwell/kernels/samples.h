// Sampled flows: each site keeps the newest message of each sampled input.
#pragma once

#include "links.h"

namespace dwell {

// An instant of a job or message that is not due in its cycle.
constexpr i64 kNotDue = -2;
// The value of a sampled input without a message.
constexpr i64 kNoValue = -1;

// Cycle of the newest message of a sampled flow on a site of its target.
template <class S>
i64& value_of(S& s, i64 site, i64 flow) {
  return s.values[site * s.n_flows + flow];
}

// Loses the values of a site whose node went down.
template <class S>
void forget_values(S& s, i64 site) {
  if (S::kRates) std::fill_n(&value_of(s, site, 0), s.n_flows, kNoValue);
}

// Keeps a message of a sampled flow as the value of a site, unless it has been overtaken.
template <class S>
void bring_value(S& s, i64, i64 cycle, i64 flow, i64 site, i64) {
  i64& value = value_of(s, site, flow);
  value = std::max(value, cycle);
}

// Gives a job that a worker takes the values of its sampled inputs.
template <class S>
void take_values(S& s, i64 key) {
  if (s.log.size == 0) return;
  const i64 cell = cell_of(key), cycle = cycle_of(key), task = item_of(key);
  const Cell& of = s.cell(cell);
  if (of.parent >= 0) return;
  for (i32 i = of.sampled_0; i < of.sampled_0 + of.n_sampled; ++i) {
    const i32 flow = s.sampled[i];
    if (s.flow(cell, flow).target != task) continue;
    const i64 value = value_of(s, s.job(key).site, flow);
    s.log_taken[s.log_row(cell, cycle) * s.n_flows + flow] = value;
  }
}

// Number of sampled flows out of a task.
template <class S>
i32 sampled_outputs(const S& s, i64 cell, const Task& from) {
  const i32* flows = &s.outputs[from.out_0];
  return static_cast<i32>(std::count_if(flows, flows + from.n_out, [&](i32 flow) {
    return s.flow(cell, flow).is_sampled != 0;
  }));
}

}  // namespace dwell
