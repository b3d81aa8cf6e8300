// Codes that the tables hold; codes.py names those that Python uses (tests hold them equal).
#pragma once

#include "rows.h"

namespace dwell {

// Outcomes of cycles and jobs.
enum Outcome : i8 { kInFlight, kDone, kDropped, kReplaced, kNodeDown };

// `kTurns` is the scheduler of a fair node whose quota is noticed at ticks.
enum Scheduler : i8 { kFair, kFifo, kPriority, kTurns };

// What a task is to the shadow of a cycle.
enum ShadowPart : i8 { kShared, kShadowed, kDiscarded };

// What a call ends with. `kPaused`: `closed_cell` is to be decided on; stamp the next cycles and
// call again. `kFinished`: no window is left to close. `kGrowEvents`, `kGrowRing`: enlarge the
// queue, or the ring of cycles in flight, and call again; nothing was lost. `kStep`: the caller's
// event `step_key` is due at `step_ns`. `kBusy`: the budget of events is spent; call again.
enum Status : i8 { kPaused, kFinished, kGrowEvents, kGrowRing, kStep, kBusy };

// Built-in policies, and why they decide as they do.
enum Policy : i8 { kStatic, kDtp, kCusum, kLatencyFirst, kAtp };
enum Reason : i8 { kDwell, kHold, kMove, kCapped, kInfeasible };

// Tiers of nodes as J has them; of other nodes caps alone take notice.
enum Tier : i8 { kRobot, kEdge, kCloud, kNoTier };

// Kinds of events in the order in which equal times are handled. `kMigrate` and `kGuard` are steps
// of the caller's: of a cold migration, and of the guard where it is woken.
enum Kind : i8 {
  kCompletion,
  kArrival,
  kStart,
  kRetry,
  kChange,
  kRestart,
  kMigrate,
  kClose,
  kDecide,
  kGuard,
  kRelease,
};

// A key packs (kind, cell, cycle, item), so that keys order as the tuple does. The item is a task
// or a flow of the cell, a site, or nothing, according to the kind.
constexpr int kItemBits = 14, kCycleBits = 32, kCellBits = 13;
constexpr int kCycleShift = kItemBits;
constexpr int kCellShift = kCycleShift + kCycleBits;
constexpr int kKindShift = kCellShift + kCellBits;
constexpr i64 kItemMask = (i64{1} << kItemBits) - 1;
constexpr i64 kCycleMask = (i64{1} << kCycleBits) - 1;
constexpr i64 kCellMask = (i64{1} << kCellBits) - 1;
// Marks an arrival that is the loss of a message; flows stay below it.
constexpr i64 kLostOnLink = i64{1} << (kItemBits - 1);
// Marks a job on the ready list that a worker has taken already; the kind's place is free there.
constexpr i64 kTaken = i64{1} << kKindShift;
// A foreign thread among those that wait for their turn, where jobs have their keys.
constexpr i64 kForeign = -1;

constexpr i64 make_key(Kind kind, i64 cell, i64 cycle, i64 item) {
  return (static_cast<i64>(kind) << kKindShift) | (cell << kCellShift) | (cycle << kCycleShift) |
         item;
}
constexpr Kind kind_of(i64 key) { return static_cast<Kind>(key >> kKindShift); }
constexpr i64 cell_of(i64 key) { return (key >> kCellShift) & kCellMask; }
constexpr i64 cycle_of(i64 key) { return (key >> kCycleShift) & kCycleMask; }
constexpr i64 item_of(i64 key) { return key & kItemMask; }
constexpr i64 job_key(i64 cell, i64 cycle, i64 task) {
  return make_key(kCompletion, cell, cycle, task);
}

}  // namespace dwell
