// Codes in the tables; codes.py repeats the codes that Python uses, and tests compare the two.
#pragma once

#include "rows.h"

namespace dwell {

// Outcomes of cycles and jobs; `kNotApplied` is an outcome of live cycles only.
enum Outcome : i8 { kInFlight, kDone, kDropped, kReplaced, kNodeDown, kNotApplied, kIdle };

// `kTurns` is the scheduler of a fair node whose quota takes effect at ticks.
enum Scheduler : i8 { kFair, kFifo, kPriority, kTurns };

// Role of a task for the shadow of a cycle.
enum ShadowPart : i8 { kShared, kShadowed, kDiscarded };

// Status of a call. `kPaused`: a decision is due on `closed_cell`; stamp the next cycles and call
// again. `kFinished`: all windows have ended. `kGrowEvents`, `kGrowRing`: enlarge the queue, or the
// ring of cycles in flight, and call again; all state is kept. `kStep`: the caller's event
// `step_key` is due at `step_ns`. `kBusy`: the budget of events is spent; call again.
enum Status : i8 { kPaused, kFinished, kGrowEvents, kGrowRing, kStep, kBusy };

// Built-in policies, and the reasons of their decisions.
enum Policy : i8 { kStatic, kDtp, kCusum, kLatencyFirst, kAtp };
enum Reason : i8 { kDwell, kHold, kMove, kCapped, kInfeasible };

// Tiers of nodes in J; only the caps consider nodes without a tier.
enum Tier : i8 { kRobot, kEdge, kCloud, kNoTier };

// Kinds of events, in the order in which events of one instant are handled. The caller handles
// `kMigrate`, a step of a cold migration, and `kGuard`, if the guard is woken.
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

// A key packs (kind, cell, cycle, item), and keys have the order of these tuples. The kind
// determines the item: a task or a flow of the cell, a site, a server, or nothing.
constexpr int kItemBits = 14, kCycleBits = 32, kCellBits = 13;
constexpr int kCycleShift = kItemBits;
constexpr int kCellShift = kCycleShift + kCycleBits;
constexpr int kKindShift = kCellShift + kCellBits;
constexpr i64 kItemMask = (i64{1} << kItemBits) - 1;
constexpr i64 kCycleMask = (i64{1} << kCycleBits) - 1;
constexpr i64 kCellMask = (i64{1} << kCellBits) - 1;
// An instant of a job or message that is not due in its cycle, or that was cancelled.
constexpr i64 kNotDue = -2;
// Marks an arrival event that loses the message; numbers of flows are smaller.
constexpr i64 kLostOnLink = i64{1} << (kItemBits - 1);
// Marks a job on the ready list that a worker has already taken, in a bit of the kind, which is 0.
constexpr i64 kTaken = i64{1} << kKindShift;
// Key of a foreign thread in the heap of threads that wait for their turn.
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
