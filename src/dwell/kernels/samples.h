// Sampled flows: each site keeps the newest message of each sampled input.
#pragma once

#include "links.h"

namespace dwell {

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

// Site of a flow's target in a cycle.
template <class S>
i32 place_of(const S& s, i64 cell, i64 cycle, i64 flow) {
  const i64 candidate = s.cell(cell).candidate_0 + s.stamp(cell, cycle);
  return s.site_of[candidate * s.n_tasks + s.flow(cell, flow).target];
}

// Sends a forward for the first time (attempt 0) or once more; it belongs to no cycle.
template <class S>
void send_forward(S& s, i64 key, i64 attempt, i64 now) {
  const i64 cycle = cycle_of(key), number = item_of(key) - (kLostOnLink + s.n_flows);
  const i64 hop_row = s.forwards[s.cell(cell_of(key)).forward_0 + number].hop;
  const Hop& hop = s.hops[hop_row];
  Link& link = s.links[hop.link];
  const i64 start = begin(s, link, now);
  const Segment& segment = s.segments[link.segment];
  const Rate& rate = s.rates[link.segment];
  if (segment.is_down) {
    if (link.retransmit_ns >= 0) lose_behind(s, key);
    return;
  }
  const i64 sent = transmit(s, cell_of(key), hop, link, rate, start);
  if (!loses(hop, rate, cycle, attempt)) {
    const i64 arrival = later(sent, propagation_ns(s, hop_row, segment, cycle));
    post_arrival(s, hop.link, key, arrival, attempt > 0);
  } else if (link.retransmit_ns >= 0) {
    if (link.in_order && attempt == 0) hold(s, hop.link, key, kUnknown);
    s.repeats[s.clock[0].n_repeats++] = Repeat{key, attempt};
    s.post(later(sent, link.retransmit_ns), make_key(kRetry, cell_of(key), cycle, item_of(key)));
  }
}

// Forwards the value of a site to another site, unless that has it or a newer one, or was sent one.
template <class S>
void forward(S& s, i64 cell, i64 flow, i64 from_site, i64 to_site, i64 now) {
  const i64 cycle = value_of(s, from_site, flow);
  if (cycle == kNoValue || value_of(s, to_site, flow) >= cycle) return;
  const Cell& of = s.cell(cell);
  for (i64 number = 0; number < of.n_forwards; ++number) {
    const Forward& row = s.forwards[of.forward_0 + number];
    if (row.flow != flow || row.from_site != from_site || row.to_site != to_site) continue;
    i64& forwarded = s.forwarded[of.forward_0 + number];
    if (forwarded >= cycle) return;
    forwarded = cycle;
    send_forward(s, make_key(kArrival, cell, cycle, kLostOnLink + s.n_flows + number), 0, now);
    return;
  }
}

// Keeps a message of a sampled flow as the value of a site, unless it has been overtaken. Forwards
// it if the target runs elsewhere.
template <class S>
void bring_value(S& s, i64 cell, i64 cycle, i64 flow, i64 site, i64 now) {
  i64& value = value_of(s, site, flow);
  if (cycle <= value) return;
  value = cycle;
  const i64 place = place_of(s, cell, s.cell(cell).released - 1, flow);
  if (place != site) forward(s, cell, flow, site, place, now);
}

// Handles a forward that reaches its node.
template <class S>
void arrive_forward(S& s, i64 cell, i64 cycle, i64 item, i64 now) {
  const i64 number = item - (kLostOnLink + s.n_flows);
  const Forward& row = s.forwards[s.cell(cell).forward_0 + number];
  if (s.server(s.sites[row.to_site]).is_down) return;
  bring_value(s, cell, cycle, row.flow, row.to_site, now);
}

// Sends a forward again after a lost attempt.
template <class S>
void retry_forward(S& s, i64 cell, i64 cycle, i64 item, i64 now) {
  const i64 key = make_key(kArrival, cell, cycle, item);
  i64 row = 0;
  while (s.repeats[row].key != key) ++row;
  const i64 attempt = s.repeats[row].attempt + 1;
  s.repeats[row] = s.repeats[--s.clock[0].n_repeats];
  send_forward(s, key, attempt, now);
}

// Forwards the values of targets that run elsewhere from a cycle on, when it is released.
template <class S>
void move_values(S& s, i64 cell, i64 cycle, i64 now) {
  if (cycle == 0 || s.stamp(cell, cycle) == s.stamp(cell, cycle - 1)) return;
  const Cell& of = s.cell(cell);
  for (i32 i = of.sampled_0; i < of.sampled_0 + of.n_sampled; ++i) {
    const i32 flow = s.sampled[i];
    const i64 from_site = place_of(s, cell, cycle - 1, flow);
    const i64 to_site = place_of(s, cell, cycle, flow);
    if (from_site != to_site) forward(s, cell, flow, from_site, to_site, now);
  }
}

// Gives a job that a worker takes the values of its sampled inputs.
template <class S>
void take_values(S& s, i64 key) {
  if (S::kPlain || s.log.size == 0) return;
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
  return static_cast<i32>(std::count_if(
      flows, flows + from.n_out, [&](i32 flow) { return s.flow(cell, flow).is_sampled != 0; }));
}

}  // namespace dwell
