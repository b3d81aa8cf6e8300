// The event loop: one call simulates up to the next decision, or to the end.
#pragma once

#include "metrics.h"
#include "rules.h"

namespace dwell {

// `kPaused` if there is room for all that the next event may add; else the status for the full
// table.
template <class S>
Status room(const S& s, i64 margin) {
  if (!s.queue.has_room(margin + s.clock[0].n_held)) return kGrowEvents;
  const i64 key = s.queue.first().key;
  if (kind_of(key) != kRelease) return kPaused;
  if (s.slot(cell_of(key), cycle_of(key)).live > 0) return kGrowRing;
  const i64 shadow = S::kPlain ? -1 : s.cell(cell_of(key)).shadow;
  if (shadow >= 0 && s.slot(shadow, cycle_of(key)).live > 0) return kGrowRing;
  return kPaused;
}

template <class S>
void handle(S& s, i64 key, i64 now) {
  const i64 cell = cell_of(key), cycle = cycle_of(key), item = item_of(key);
  switch (kind_of(key)) {
    case kCompletion:
      complete(s, key, now);
      break;
    case kArrival:
      if (is_forward(s, item)) {
        arrive_forward(s, cell, cycle, item, now);
      } else if (!is_given_up(s, cell, cycle)) {
        arrive(s, cell, cycle, item, now);
      }
      break;
    case kStart:
      if (S::kRates && item >= s.n_tasks) {
        hear(s, cell, cycle, item - s.n_tasks);
      } else if (!is_given_up(s, cell, cycle)) {
        start_source(s, cell, cycle, item);
      }
      break;
    case kRetry:
      if (is_forward(s, item)) {
        retry_forward(s, cell, cycle, item, now);
      } else if (is_given_up(s, cell, cycle)) {
        end_repeats(s, make_key(kArrival, cell, cycle, item), now);
      } else {
        retry(s, cell, cycle, item, now);
      }
      break;
    case kChange:
      if (item == 0) {
        change_node(s, now);
      } else if (S::kQuotas) {
        look_at_quota(s, s.servers[item - 1], now);
      }
      break;
    case kRestart:
      restart(s, s.sites[item], now);
      break;
    case kRelease:
      open_window(s, cell, cycle, now);
      if (s.cell(cell).decide_cycles != 0) open_looks(s, cell, cycle, now);
      release(s, cell, cycle, now);
      break;
    case kMigrate:
    case kClose:
    case kDecide:
    case kGuard:
      break;  // handled by `play`
  }
}

// Lets the built-in policy decide, if any; returns whether the call ends here.
template <class S>
[[gnu::noinline]] bool pauses_at(S& s, i64 index) {
  if (s.rule.size == 0) return s.clock[0].pauses != 0;
  if (!decide(s, index)) return true;
  stamp_next(s);
  return false;
}

// Handles events until a decision is due (if `pauses` is set), room or the budget runs out, or all
// windows have ended.
//
// Frequent functions are inlined here (`flatten`), which saves a sixth of the time.
template <class S>
[[gnu::flatten]] Status play(S& s) {
  // Number of cells that wait for the end of a window, or migrate; at 0 the run is over.
  i64 waiting = 0;
  for (i64 cell = 0; cell < s.cells.size; ++cell) {
    waiting += announce_close(s, cell);
    announce_look(s, cell);
  }
  const i64 margin = s.clock[0].margin, end_ns = s.clock[0].end_ns;
  const bool plays_on = s.clock[0].plays_on != 0;
  i64 budget = s.clock[0].budget;
  while ((waiting > 0 || plays_on) && !s.queue.is_empty()) {
    const Status status = room(s, margin);
    if (status != kPaused) return status;
    if (--budget < 0) return kBusy;
    const Event event = s.queue.first();
    const i64 now = event.at_ns;
    s.queue.pop();
    const Kind kind = kind_of(event.key);
    const i64 cell = cell_of(event.key);
    if (kind == kClose) {
      // The guard has cut this window short; its event is invalid.
      if (cycle_of(event.key) != s.cell(cell).close_cycle) continue;
      const i64 window = s.cell(cell).window;
      close_window(s, cell, now);
      if (s.cell(cell).decide_cycles == 0 && pauses_at(s, window)) return kPaused;
      waiting += announce_close(s, cell) - 1;
      continue;
    }
    if (kind == kDecide) {
      // A move has postponed this decision; its event is invalid.
      if (cycle_of(event.key) != s.cell(cell).look_cycle) continue;
      // The last window has closed: a decision would have no effect.
      if (!s.cell(cell).close_pending && !s.cell(cell).migrating && !plays_on) continue;
      const i64 index = s.cell(cell).look;
      look(s, cell, now);
      if (pauses_at(s, index)) return kPaused;
      announce_look(s, cell);
      continue;
    }
    if (now > end_ns) break;
    if (kind == kMigrate || (kind == kGuard && wakes_guard(s, cell, now))) {
      s.clock[0].step_key = event.key;
      s.clock[0].step_ns = now;
      return kStep;
    }
    handle(s, event.key, now);
    settle(s, now);
    flush(s, now);
  }
  return kFinished;
}

}  // namespace dwell
