// Turns: if a quota takes effect at ticks, one thread at a time has the core.
//
// All other threads, foreign threads too, are in the heap of waiting threads, ordered by the core
// time that each has received.
#pragma once

#include "elementary.h"
#include "quotas.h"

namespace dwell {

// Between equal core times, jobs go before foreign threads.
constexpr i64 kLate = kLastNs;

inline void end_turn(Quota& quota) {
  quota.has_turn = 0;
  quota.turn_ns = 0;
}

// Core time that the current thread has received; the clock must be up to date.
inline i64 received_by_turn(const Quota& quota) { return quota.turn_begun_ns + quota.turn_ns; }

// Returns the current thread to the heap of waiting threads; the clock must be up to date.
template <class S>
void put_back(S& s, Server& server, Quota& quota) {
  const i64 received = received_by_turn(quota);
  if (server.n_run == 0) {
    queue_up(s, server, Waiting{received, kLate, kForeign, 0.0});
  } else {
    const Running& first = *running_of(s, server);
    const f64 left = std::max(first.finish_ns - server.virtual_ns, 0.0);
    note_beside(s, server, first);
    queue_up(s, server, Waiting{received, s.job(first.key).ready_ns, first.key, left});
    server.n_run = 0;
  }
  end_turn(quota);
}

// Ends the turn, if it has lasted long enough; the clock must be up to date.
template <class S>
void pass_on(S& s, Server& server, Quota& quota) {
  if (quota.turn_ns >= quota.least_ns && !server.is_stopped) put_back(s, server, quota);
}

// Ends the turn at a tick, if it has lasted long enough, or at a wake, if a waiting thread has
// received less; the clock must be up to date.
template <class S>
void strike(S& s, Server& server, Quota& quota, i64 now) {
  if ((now + quota.tick_ago_ns) % quota.tick_ns == 0) pass_on(s, server, quota);
  const bool runs = quota.has_turn && !server.is_stopped;
  if (quota.wakes_ns == now && runs && server.n_wait > 0) {
    if (waiting_of(s, server)->rank < received_by_turn(quota)) put_back(s, server, quota);
  }
}

// Checks, as Linux does, whether a quota is used up; the server's clock must be up to date.
//
// Core time beyond the quota is a debt. A stopped server resumes when refills have paid the debt
// (distribute_cfs_runtime); a running server draws a slice (assign_cfs_rq_runtime), or stops.
template <class S>
void notice(S& s, Server& server, Quota& quota, i64 now) {
  renew(s, server, quota, now);
  if (quota.left_ns <= 0) {
    const i64 wanted = server.is_stopped ? 1 : quota.drawn_ns;
    const i64 drawn = std::min(quota.pool_ns, wanted - quota.left_ns);
    quota.pool_ns -= drawn;
    quota.left_ns += drawn;
  }
  const bool stops = quota.left_ns <= 0;
  if (stops && !server.is_stopped && quota.has_turn) put_back(s, server, quota);
  server.is_stopped = stops;
  set_speed(s, server);
}

// Next instant after now at which a background thread wakes: a Poisson process.
inline i64 next_wake(Quota& quota, i64 now) {
  while (quota.wakes_ns <= now) {
    const f64 drawn = attempt_uniform(quota.wake_key, quota.wakes++, 0);
    const i64 gap_ns = whole_ns(-log(1.0 - drawn) * quota.wake_gap_ns);
    quota.wakes_ns = later(quota.wakes_ns + 1, gap_ns);
  }
  return quota.wakes_ns;
}

// Instant of the next check of the quota of a busy server: for a stopped server the begin of a
// period, else the next tick or wake of the background.
template <class S>
i64 next_look(S&, Server& server, Quota& quota, i64 now) {
  if (server.is_stopped) return (quota.period + 1) * quota.period_ns - quota.period_ago_ns;
  if (quota.looks_ns == now) return now;  // the check of this instant is still pending
  const i64 tick_ns = now + quota.tick_ns - (now + quota.tick_ago_ns) % quota.tick_ns;
  return std::min(tick_ns, next_wake(quota, now));
}

// Mean core time that the threads of a server have received; a new thread begins with it.
template <class S>
i64 average(const S& s, const Server& server, const Quota& quota) {
  const Waiting* waiting = waiting_of(s, server);
  i64 n = server.n_wait;
  // Subtract one of the ranks first: 64 bits may not hold the sum.
  const i64 origin = n > 0 ? waiting->rank : 0;
  i64 beyond = 0;
  for (i64 i = 0; i < n; ++i) beyond += waiting[i].rank - origin;
  if (quota.has_turn) {
    beyond += received_by_turn(quota) - origin;
    ++n;
  }
  if (n == 0) return 0;
  const i64 down = beyond % n < 0 ? 1 : 0;  // rounded down
  return origin + beyond / n - down;
}

// Gives a free turn to the waiting thread that has received least, if the quota allows.
template <class S>
void take_turn(S& s, Server& server, i64 now) {
  Quota& quota = s.quotas[server.quota];
  tick(s, server, now);
  notice(s, server, quota, now);
  if (server.n_wait == 0 || quota.has_turn || server.is_stopped) return;
  const Waiting first = *waiting_of(s, server);
  quota.has_turn = 1;
  quota.turn_begun_ns = first.rank;
  pop(waiting_of(s, server), server.n_wait--);
  if (first.key == kForeign) return;
  run(s, server, first.key, s.job(first.key), first.left_ns, now);
  set_speed(s, server);
}

// Replaces the foreign threads that take turns by `threads` new threads; the clock must be up to
// date.
template <class S>
void restress(S& s, Server& server, i64 threads) {
  Quota& quota = s.quotas[server.quota];
  const i64 received = average(s, server, quota);
  const i64 n = server.n_wait;
  server.n_wait = 0;
  // In place: the heap of jobs never overtakes the row that is read.
  for (i64 i = 0; i < n; ++i) {
    const Waiting row = waiting_of(s, server)[i];
    if (row.key != kForeign) queue_up(s, server, row);
  }
  if (server.n_run == 0) end_turn(quota);
  for (i64 i = 0; i < threads; ++i) queue_up(s, server, Waiting{received, kLate, kForeign, 0.0});
}

// Queues a job that a worker has taken for its turn; its core time starts at the mean.
template <class S>
void line_up(S& s, Server& server, const Job& job, i64 key, i64 work_ns, i64 now) {
  tick(s, server, now);
  const i64 received = average(s, server, s.quotas[server.quota]);
  queue_up(s, server, Waiting{received, job.ready_ns, key, static_cast<f64>(work_ns)});
  server.used += 1;
  mark(s, server);
}

}  // namespace dwell
