// Parts of the kernel that Python does not call, for the tests of each.

#include "attempts.h"
#include "codes.h"
#include "export.h"
#include "heaps.h"
#include "instants.h"
#include "queue.h"

using namespace dwell;

constexpr i64 kTake = -1;

// Adds every step with its key, or takes the first event where it is kTake; returns how many were
// taken. Days are of 2^bits.
DWELL_EXPORT i64 part_events(const i64* steps, const i64* keys, i64 n, Event* room, i32* following,
                             i64 size, i32* days, i64 n_days, i64 bits, Event* taken) noexcept {
  Clock clock{};
  clock.day_bits = bits;
  i64 count = 0;
  for (i64 i = 0; i < n; ++i) {
    // It outlives a call in its tables.
    Queue queue({room, size}, {following, size}, {days, n_days}, clock);
    if (steps[i] != kTake) {
      queue.push(steps[i], keys[i]);
    } else if (!queue.is_empty()) {
      taken[count++] = queue.first();
      queue.pop();
    }
    queue.save(clock);
  }
  return count;
}

// Adds every step, or takes the entry at a place where it is kTake; returns how many are left.
DWELL_EXPORT i64 part_running(const i64* steps, const i64* places, i64 n, Running* heap) noexcept {
  i64 count = 0;
  for (i64 key = 0; key < n; ++key) {
    if (steps[key] != kTake) {
      push(heap, count++, Running{static_cast<f64>(steps[key]), key});
    } else if (count > 0) {
      pop(heap, count, places[key] % count);
      --count;
    }
  }
  return count;
}

// Orders waiting jobs: adds all, then takes all.
DWELL_EXPORT void part_waiting(const Waiting* jobs, i64 n, Waiting* heap, Waiting* taken) noexcept {
  for (i64 i = 0; i < n; ++i) push(heap, i, jobs[i]);
  for (i64 i = 0; i < n; ++i) {
    taken[i] = heap[0];
    pop(heap, n - i);
  }
}

DWELL_EXPORT i64 part_later(i64 t, i64 duration) noexcept { return later(t, duration); }
DWELL_EXPORT i64 part_whole_ns(f64 duration) noexcept { return whole_ns(duration); }
DWELL_EXPORT i64 part_ceil_ns(f64 duration) noexcept { return ceil_ns(duration); }
DWELL_EXPORT i64 part_last_ns() noexcept { return kLastNs; }
DWELL_EXPORT f64 part_attempt_uniform(u64 key, i64 cycle, i64 attempt) noexcept {
  return attempt_uniform(key, cycle, attempt);
}
DWELL_EXPORT i64 part_key(i64 kind, i64 cell, i64 cycle, i64 item) noexcept {
  return make_key(static_cast<Kind>(kind), cell, cycle, item);
}

// The last code of every kind of codes, in the order of codes.py, and what bounds flows.
DWELL_EXPORT void part_codes(i64* out) noexcept {
  for (const i64 code : {i64{kNodeDown}, i64{kTurns}, i64{kDiscarded}, i64{kBusy}, i64{kRelease},
                         i64{kGuard}, i64{kMigrate}, i64{kStep}, kLostOnLink - 1}) {
    *out++ = code;
  }
}
