// The order of links with `in_order`: messages arrive in the order of their first attempts.
//
// The end of a repeat is unknown beforehand. Messages behind a repeated message are *held*, in the
// order of first attempts; the first held message of a link is always being repeated.
#pragma once

#include "simulation.h"

namespace dwell {

// The arrival of a held message that is being repeated.
constexpr i64 kUnknown = -1;

// What a cycle has lost: nothing; only jobs and messages that its sinks do not need; or its
// outcome.
enum Loss : i8 { kNothing, kUnneeded, kOutcome };

// Whether waited flows lead from a task to a sink that runs in a cycle.
template <class S>
bool is_needed(const S& s, i64 cell, i64 cycle, i64 task) {
  if (!S::kRates) return true;
  const Task& from = s.task(cell, task);
  const i32* rates = &s.sink_rates[from.rate_0];
  return std::any_of(rates, rates + from.n_rates, [&](i64 every) { return cycle % every == 0; });
}

// Marks a cycle that has lost a job of a task, or a message to the task. The first loss that a sink
// needs determines the outcome.
template <class S>
void lose(S& s, i64 cell, i64 cycle, i64 task, Outcome outcome) {
  Slot& slot = s.slot(cell, cycle);
  if (slot.is_lost == kOutcome) return;
  // The other copy has completed the cycle.
  if (S::kRates && s.outcome[s.output(cell, cycle)] == kDone) return;
  if (!is_needed(s, cell, cycle, task)) {
    slot.is_lost = kUnneeded;
    return;
  }
  slot.is_lost = kOutcome;
  s.outcome[s.output(cell, cycle)] = outcome;
}

// Marks a cycle that has lost the message of a flow.
template <class S>
void lose_input(S& s, i64 cell, i64 cycle, i64 flow, Outcome outcome) {
  const Flow& ends = s.flow(cell, flow);
  if (S::kRates && ends.is_sampled) {
    Slot& slot = s.slot(cell, cycle);
    slot.is_lost = std::max<i32>(slot.is_lost, kUnneeded);
  } else {
    lose(s, cell, cycle, ends.target, outcome);
  }
}

// Whether a cycle belongs to a shadow that has been given up.
template <class S>
bool is_given_up(const S& s, i64 cell, i64 cycle) {
  if (S::kPlain || s.cell(cell).parent < 0) return false;
  const Cell& parent = s.cell(s.cell(cell).parent);
  return cycle + parent.given_up_after < parent.released;
}

// Whether the item of an arrival, or of a repeat, is a forward: after all flows, lost ones
// included.
template <class S>
bool is_forward(const S& s, i64 item) {
  return S::kRates && item >= kLostOnLink + s.n_flows;
}

// Adds a message behind all held messages; `key` is the event of its arrival.
template <class S>
void hold(S& s, i64 link, i64 key, i64 arrival_ns) {
  s.held[s.clock[0].n_held++] = Held{key, link, arrival_ns};
  s.links[link].n_held += 1;
}

// Row of a held message; the number of rows if it is not held.
template <class S>
i64 find_held(const S& s, i64 key) {
  i64 row = 0;
  while (row < s.clock[0].n_held && s.held[row].key != key) ++row;
  return row;
}

// Posts the arrivals of a link's held messages, up to the first message that is being repeated.
template <class S>
void release_held(S& s, i64 link_row) {
  Link& link = s.links[link_row];
  const i64 n_held = s.clock[0].n_held;
  bool is_blocked = false;
  i64 kept = 0;
  for (i64 row = 0; row < n_held; ++row) {
    const Held& held = s.held[row];
    const bool is_here = held.link == link_row;
    is_blocked = is_blocked || (is_here && held.arrival_ns == kUnknown);
    if (is_here && !is_blocked) {
      link.last_arrival_ns = std::max(link.last_arrival_ns, held.arrival_ns);
      link.n_held -= 1;
      s.post(link.last_arrival_ns, held.key);
    } else {
      s.held[kept++] = held;
    }
  }
  s.clock[0].n_held = kept;
}

// Ends the repeats of a held message at `arrival_ns`: it arrives, or other messages stop waiting.
template <class S>
[[gnu::noinline]] void end_repeats(S& s, i64 key, i64 arrival_ns) {
  const i64 row = find_held(s, key);
  if (row == s.clock[0].n_held) return;
  s.held[row].arrival_ns = arrival_ns;
  release_held(s, s.held[row].link);
}

// Posts the arrival of a message, or holds it.
template <class S>
void post_arrival(S& s, i64 link_row, i64 key, i64 arrival_ns, bool is_repeated) {
  Link& link = s.links[link_row];
  if (!link.in_order) {
    s.post(arrival_ns, key);
  } else if (is_repeated) {
    end_repeats(s, key, arrival_ns);
  } else if (link.n_held > 0) {
    hold(s, link_row, key, arrival_ns);
  } else {
    link.last_arrival_ns = std::max(link.last_arrival_ns, arrival_ns);
    s.post(link.last_arrival_ns, key);
  }
}

// Loses the messages held behind a message that will never arrive.
template <class S>
[[gnu::noinline]] void lose_behind(S& s, i64 key) {
  const i64 n_held = s.clock[0].n_held, first = find_held(s, key);
  for (i64 row = first + 1; row < n_held; ++row) {
    Held& held = s.held[row];
    if (held.link != s.held[first].link || held.arrival_ns == kUnknown) continue;
    held.arrival_ns = kUnknown;
    const i64 cell = cell_of(held.key), cycle = cycle_of(held.key);
    if (kind_of(held.key) != kArrival || is_given_up(s, cell, cycle)) continue;
    if (is_forward(s, item_of(held.key))) continue;
    s.slot(cell, cycle).live -= 1;
    lose_input(s, cell, cycle, item_of(held.key) & ~kLostOnLink, kInFlight);
  }
}

}  // namespace dwell
