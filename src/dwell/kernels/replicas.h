// Replicas: cycles with two copies, whose tasks run on two nodes.
//
// In a cell with replicas each task and each flow has a second row, `copies` or `flow_copies` rows
// after the first. Under a candidate with replicas a task is *doubled* if its second row has a
// site; else it is *common*, and its first row serves both copies.
#pragma once

#include "order.h"

namespace dwell {

// `missing` of a job whose node has heard that the cycle is done.
constexpr i32 kHeard = -1;
// `attempts` of a message in a cycle with replicas: not sent yet; handed over; held.
constexpr i64 kUnsent = -1, kHandedOver = -2, kIsHeld = -3;

// Whether a cycle has two copies.
template <class S>
bool has_replicas(const S& s, i64 cell, i64 cycle) {
  if (!S::kRates || s.cell(cell).copies == 0) return false;
  return s.after_ns[s.slot(cell, cycle).candidate] >= 0;
}

// Whether a task of a cell is a second copy.
template <class S>
bool is_second(const S& s, i64 cell, i64 task) {
  return S::kRates && s.cell(cell).copies > 0 && task >= s.cell(cell).copies;
}

// Row of a task that is an end of a flow: a common task has only its first row.
template <class S>
i64 end_of(const S& s, i64 cell, i64 cycle, i64 task) {
  if (!is_second(s, cell, task) || s.job(cell, cycle, task).site >= 0) return task;
  return task - s.cell(cell).copies;
}

// Whether a task is common under the candidate of a cycle with replicas.
template <class S>
bool is_common(const S& s, i64 cell, i64 cycle, i64 task) {
  return !is_second(s, cell, task) && s.job(cell, cycle, task + s.cell(cell).copies).site < 0;
}

template <class S>
i64& attempts_of(const S& s, i64 cell, i64 cycle, i64 flow) {
  return s.attempts[s.slot_row(cell, cycle) * s.n_flows + flow];
}

// Row of the task whose job waits at a site in a cycle: its first or its second copy.
template <class S>
i64 task_at(const S& s, const Site& site, i64 cycle) {
  if (!S::kRates || s.cell(site.cell).copies == 0) return site.task;
  const bool is_first = &s.site(s.job(site.cell, cycle, site.task)) == &site;
  return is_first ? site.task : site.task + s.cell(site.cell).copies;
}

// Whether a message that reaches its node is late: the node has heard that the cycle is done, or
// the other copy's message of this flow came first.
template <class S>
bool is_late(const S& s, i64 cell, i64 cycle, i64 flow, i64 target) {
  if (!has_replicas(s, cell, cycle)) return false;
  bool is_late = s.job(cell, cycle, target).missing == kHeard;
  if (!is_late && is_common(s, cell, cycle, target)) {
    const i64 copies = s.cell(cell).flow_copies;
    const i64 other = flow < copies ? flow + copies : flow - copies;
    is_late = attempts_of(s, cell, cycle, other) == kHandedOver;
  }
  if (is_late) s.late_copies[s.output(cell, cycle)] += 1;
  attempts_of(s, cell, cycle, flow) = kHandedOver;
  return is_late;
}

// Whether the node of a flow's sender has heard that the cycle is done.
template <class S>
bool is_stopped(const S& s, i64 cell, i64 cycle, i64 flow) {
  if (!has_replicas(s, cell, cycle)) return false;
  return s.job(cell, cycle, end_of(s, cell, cycle, s.flow(cell, flow).source)).missing == kHeard;
}

// Whether a cycle that is done still needs a node: to send a message that has not been handed over,
// or to run a second copy that waits for one.
template <class S>
bool is_left_on(const S& s, i64 cell, i64 cycle, i64 node) {
  const i64 copies = s.cell(cell).flow_copies;
  for (i64 flow = 0; flow < 2 * copies; ++flow) {
    if (attempts_of(s, cell, cycle, flow) == kHandedOver) continue;
    const i64 source = end_of(s, cell, cycle, s.flow(cell, flow).source);
    const i64 target = end_of(s, cell, cycle, s.flow(cell, flow).target);
    const bool waits = !is_common(s, cell, cycle, target);
    if (flow >= copies && !waits && !is_second(s, cell, source)) continue;  // there is no message
    const auto is_here = [&](i64 task) { return s.site(s.job(cell, cycle, task)).node == node; };
    if (is_here(source) || (waits && is_here(target))) return true;
  }
  return false;
}

// Announces to the nodes that a cycle still needs that it is done.
template <class S>
void announce_done(S& s, i64 cell, i64 cycle, i64 now) {
  if (!has_replicas(s, cell, cycle) || s.slot(cell, cycle).live == 0) return;
  const i64* hear_ns = &s.hear_ns[s.slot(cell, cycle).candidate * s.n_tasks];
  for (i64 task = 0; task < s.cell(cell).n_tasks; ++task) {
    if (hear_ns[task] < 0) continue;
    if (!is_left_on(s, cell, cycle, s.site(s.job(cell, cycle, task)).node)) continue;
    s.post(later(now, hear_ns[task]), make_key(kStart, cell, cycle, s.n_tasks + task));
  }
}

// Clears the inputs of a common task that its node has lost: the other copy's may still arrive.
template <class S>
bool await_again(S& s, i64 cell, i64 cycle, i64 task) {
  if (!has_replicas(s, cell, cycle) || !is_common(s, cell, cycle, task)) return false;
  const Cell& of = s.cell(cell);
  s.job(cell, cycle, task).missing = s.task(cell, task).n_in;
  for (i64 flow = 0; flow < of.flow_copies; ++flow) {
    if (s.flow(cell, flow).target != task) continue;
    for (const i64 copy : {flow, flow + of.flow_copies}) {
      i64& attempts = attempts_of(s, cell, cycle, copy);
      if (attempts == kHandedOver) attempts = kUnsent;
    }
  }
  return true;
}

// Loses the messages of a cycle that a node holds.
template <class S>
void lose_held(S& s, i64 cell, i64 cycle, i64 node) {
  if (!has_replicas(s, cell, cycle)) return;
  const Cell& of = s.cell(cell);
  const i64 copies = of.flow_copies;
  for (i64 flow = copies; flow < 2 * copies; ++flow) {
    const i64 sender = end_of(s, cell, cycle, s.flow(cell, flow).source);
    i64& attempts = attempts_of(s, cell, cycle, flow);
    if (attempts != kIsHeld || s.site(s.job(cell, cycle, sender)).node != node) continue;
    attempts = kUnsent;
    s.slot(cell, cycle).live -= 1;
    lose_input(s, cell, cycle, flow, kNodeDown);
  }
}

}  // namespace dwell
