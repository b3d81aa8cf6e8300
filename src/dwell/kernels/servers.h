// Servers: the speed of running jobs, and the next completion.
//
// All running jobs of a server advance at one common speed, and so does a virtual clock. The clock
// turns processor sharing into a heap: a job that starts at virtual time v with c nanoseconds of
// work ends at virtual time v + c, even if other jobs start or end before. The work of a job that
// holds fewer cores than it has threads is scaled by threads / cores. The virtual clock is reset to
// 0 when a job starts on an empty server, which keeps its rounding error below a picosecond in
// practice.
#pragma once

#include <algorithm>
#include <cmath>

#include "heaps.h"
#include "simulation.h"

namespace dwell {

// Why a server is in `dirty`: its own jobs changed, or only jobs of the server below it.
enum Dirty : i8 { kIsDirty = 1, kBelowIsDirty = 2 };

// Work left below this many nanoseconds is rounding, not work.
constexpr f64 kSlackNs = 1e-3;

// Defined in quotas.h and turns.h.
template <class S>
void refill(S& s, Server& server, i64 now);
template <class S>
void announce_quota(S& s, Server& server, i64 now);
template <class S>
void take_turn(S& s, Server& server, i64 now);
template <class S>
void line_up(S& s, Server& server, const Job& job, i64 key, i64 work_ns, i64 now);
inline void end_turn(Quota& quota);

// Defined in remainders.h.
template <class S>
bool is_awaited(const S& s, const Server& server, const Site& site, i64 now);

template <class S>
bool takes_turns(const S&, const Server& server) {
  return S::kQuotas && server.scheduler == kTurns;
}

template <class S>
bool has_quota(const S&, const Server& server) {
  return S::kQuotas && server.quota >= 0;
}

template <class S>
Running* running_of(const S& s, const Server& server) {
  return &s.running[server.base];
}

template <class S>
Waiting* waiting_of(const S& s, const Server& server) {
  return &s.waiting[server.base];
}

// Undisturbed duration of a job with the cores that it holds; `work_ns` is its execution time.
inline f64 time_alone(const Site& site, i64 work_ns) {
  const f64 work = static_cast<f64>(work_ns);
  if (site.need == site.threads) return work;
  return work * static_cast<f64>(site.threads) / static_cast<f64>(site.need);
}

// Whether a server is the rest of another server, left by own jobs to shadow jobs.
template <class S>
bool is_below(const S&, const Server& server) {
  return !S::kPlain && server.above >= 0;
}

template <class S>
bool has_below(const S&, const Server& server) {
  return !S::kPlain && server.below >= 0;
}

// Whether shadow jobs run or wait on the server below.
template <class S>
bool is_shared(const S& s, const Server& server) {
  if (!has_below(s, server)) return false;
  const Server& below = s.servers[server.below];
  return below.n_run + below.n_wait > 0;
}

// Busy cores of shadow jobs that draw on a server's quota.
template <class S>
i64 lent(const S&, const Server& server) {
  return S::kPlain ? 0 : server.lent;
}

// Marks a server that must assign cores at the end of the event. A server below another does so
// after the server above.
template <class S>
void mark(S& s, Server& server) {
  Server& first = is_below(s, server) ? s.servers[server.above] : server;
  if (!first.is_dirty) s.dirty[s.n_dirty++] = static_cast<i32>(&first - s.servers.rows);
  first.is_dirty |= is_below(s, server) ? kBelowIsDirty : kIsDirty;
}

// Whether logs have the integrals of the threads that ran at the same time as a job.
template <class S>
bool logs_beside(const S& s) {
  return !S::kPlain && s.log.size > 0 && s.clock[0].has_shared != 0;
}

// Integral, up to now, of the threads or places of a server that jobs use.
inline i64 used_until(const Server& server, i64 now) {
  const f64 since_ns = static_cast<f64>(now - server.last_ns);
  return whole_ns(std::rint(server.used_ns + since_ns * static_cast<f64>(server.used)));
}

// Adds a server's integrals to a log entry, or with sign -1 subtracts them.
template <class S>
void log_beside(const S& s, const Server& server, Log& entry, i64 sign, i64 now) {
  if (!logs_beside(s)) return;
  entry.used_ns += sign * used_until(server, now);
  if (is_below(s, server)) entry.above_ns += sign * used_until(s.servers[server.above], now);
}

// Updates a server's busy time to now; returns the time since the last update.
template <class S>
i64 account(S& s, Server& server, i64 now) {
  const i64 elapsed = now - server.last_ns;
  const i64 busy = server.used + server.stress;
  server.last_ns = now;
  if (logs_beside(s)) server.used_ns += static_cast<f64>(elapsed) * static_cast<f64>(server.used);
  if (elapsed <= 0 || server.is_down) return elapsed;
  if (is_below(s, server)) {
    if (server.is_stopped) return elapsed;
    server.busy_ns += static_cast<f64>(elapsed) * static_cast<f64>(server.lent);
    server.behind_ns += static_cast<f64>(elapsed) * server.background;
    return elapsed;
  }
  if (server.background > 0.0) {
    f64 background = server.background;
    if (!has_quota(s, server)) {
      background = std::min(background, static_cast<f64>(std::max<i64>(server.cores - busy, 0)));
    }
    server.behind_ns += static_cast<f64>(elapsed) * background;
  }
  if (busy > 0 && !server.is_stopped) {
    const i64 taken = std::min(busy, server.cores);
    server.busy_ns += static_cast<f64>(elapsed) * static_cast<f64>(taken);
    if (has_quota(s, server)) {
      Quota& quota = s.quotas[server.quota];
      quota.left_ns -= elapsed * taken;
      quota.turn_ns += elapsed * taken;
    }
  }
  if (has_quota(s, server) && !server.is_stopped) {
    s.quotas[server.quota].left_ns -= elapsed * lent(s, server);
  }
  return elapsed;
}

// Whether jobs need more core time next to foreign threads, so this work is counted separately.
template <class S>
bool counts_beside(const S&, const Server& server) {
  return !S::kPlain && server.beside != 1.0;
}

// Advances a server's virtual clock by an elapsed time.
template <class S>
void advance_clock(S& s, Server& server, i64 elapsed) {
  const f64 advanced = static_cast<f64>(elapsed) * server.speed;
  server.virtual_ns += advanced;
  if (counts_beside(s, server) && server.stress > 0) server.beside_ns += advanced;
}

// Updates a server's virtual clock and busy time to now.
template <class S>
void tick(S& s, Server& server, i64 now) {
  const i64 elapsed = account(s, server, now);
  if (server.n_run > 0) advance_clock(s, server, elapsed);
}

// Sets the common speed after threads, stress or quota changed; the clock must be up to date.
//
// With c' = c - b cores left by the background, K threads of jobs and s foreign threads, fair:
// min(1, c' / (K + s)); fifo and priority: c' / (c + s); in turns: 1 / threads of the job that has
// the turn. Next to foreign threads the speed is multiplied by `beside`; while the quota is used up
// it is 0.
template <class S>
void set_speed(S& s, Server& server) {
  f64 speed;
  if (server.scheduler == kFair) {
    const f64 load = static_cast<f64>(server.used + server.stress);
    speed = load <= server.spare ? 1.0 : server.spare / load;
  } else if (takes_turns(s, server)) {
    i64 need = 1;
    if (server.n_run > 0) need = s.site(s.job(running_of(s, server)->key)).need;
    speed = 1.0 / static_cast<f64>(need);
  } else {
    speed = server.spare / static_cast<f64>(server.cores + server.stress);
  }
  if (server.stress > 0) speed *= server.beside;
  server.speed = server.is_stopped ? 0.0 : speed;
}

// Announces a completion, unless it is already announced; older announcements become invalid.
template <class S>
void announce(S& s, Server& server, i64 at_ns, i64 key) {
  if (key == server.next_key && at_ns == server.next_ns) return;
  server.next_key = key;
  server.next_ns = at_ns;
  s.post(at_ns, key);
}

// Least key of the running jobs, from place `i` of the heap on, that finish by a virtual instant.
inline i64 least_key(const Running* jobs, i64 n, i64 i, f64 until_ns, i64 key) {
  if (i >= n || jobs[i].finish_ns > until_ns) return key;
  key = least_key(jobs, n, 2 * i + 1, until_ns, std::min(key, jobs[i].key));
  return least_key(jobs, n, 2 * i + 2, until_ns, key);
}

// Job whose completion comes first after a wait: of several that finish within its last nanosecond,
// the first in the order of events.
[[gnu::noinline]] inline i64 next_key(const Server& server, const Running* jobs, i64 wait) {
  const f64 speed = server.speed != 0.0 ? server.speed : 1.0;
  const f64 until_ns = server.virtual_ns + (static_cast<f64>(wait) + kSlackNs) * speed;
  return least_key(jobs, server.n_run, 0, until_ns, jobs->key);
}

// Announces the completion of the job that finishes first.
template <class S>
void schedule(S& s, Server& server, i64 now) {
  if (has_quota(s, server)) announce_quota(s, server, now);
  if (server.n_run == 0 || server.is_down) {
    server.next_key = -1;
    return;
  }
  const Running* jobs = running_of(s, server);
  f64 left = jobs->finish_ns - server.virtual_ns;
  if (server.speed == 0.0 && left > kSlackNs) {
    server.next_key = -1;
    return;
  }
  if (server.speed != 1.0 && server.speed != 0.0) left = left / server.speed;
  const i64 wait = std::max<i64>(ceil_ns(left - kSlackNs), 0);
  const i64 key = server.n_run > 1 ? next_key(server, jobs, wait) : jobs->key;
  announce(s, server, later(now, wait), key);
}

// Records that a worker starts a job.
template <class S>
void note_start(S& s, i64 key, Job& job, i64 now) {
  job.started_ns = now;
  if (S::kPlain || s.log.size == 0) return;
  Log& entry = s.log[s.log_entry(cell_of(key), cycle_of(key), item_of(key))];
  entry.start_ns = now;
  log_beside(s, s.server(s.site(job)), entry, -1, now);
}

// Starts or resumes a job that has `left` nanoseconds of work.
template <class S>
void run(S& s, Server& server, i64 key, Job& job, f64 left, i64 now) {
  if (server.n_run == 0) server.virtual_ns = server.beside_ns = 0.0;
  if (job.started_ns < 0) note_start(s, key, job, now);
  if (counts_beside(s, server)) job.beside_ns -= server.beside_ns;
  push(running_of(s, server), server.n_run++, Running{server.virtual_ns + left, key});
}

// Adds the work that a stopping job did next to foreign threads; the clock must be up to date.
template <class S>
void note_beside(S& s, const Server& server, const Running& row) {
  if (!counts_beside(s, server)) return;
  // The end is rounded up to a whole nanosecond: do not count the clock beyond the job's finish.
  const f64 past = server.stress > 0 ? std::min(row.finish_ns - server.virtual_ns, 0.0) : 0.0;
  s.job(row.key).beside_ns += server.beside_ns + past;
}

template <class S>
void start(S& s, Server& server, const Site& site, i64 key, Job& job, f64 left, i64 now) {
  run(s, server, key, job, left, now);
  server.used += site.need;
}

// Rank of a job; the smallest runs first, and readiness decides between equal ranks.
inline i64 rank_of(const Server& server, const Site& site) {
  return server.scheduler == kFifo ? 0 : site.rank;
}

// Queues a job that waits for cores, or a thread that waits for its turn.
template <class S>
void queue_up(S& s, Server& server, const Waiting& row) {
  push(waiting_of(s, server), server.n_wait++, row);
}

// Preempts the last in order of the running jobs behind `last`; returns false if all precede it.
template <class S>
[[gnu::noinline]] bool preempt(S& s, Server& server, Waiting last) {
  Running* running = running_of(s, server);
  i64 worst = -1;
  for (i64 i = 0; i < server.n_run; ++i) {
    const f64 left = running[i].finish_ns - server.virtual_ns;
    if (left <= kSlackNs) continue;  // it has all its work and completes at this very instant
    const Job& job = s.job(running[i].key);
    const Waiting other{rank_of(server, s.site(job)), job.ready_ns, running[i].key, left};
    if (last < other) {
      last = other;
      worst = i;
    }
  }
  if (worst < 0) return false;
  note_beside(s, server, running[worst]);
  pop(running, server.n_run--, worst);
  server.used -= s.site(s.job(last.key)).need;
  queue_up(s, server, last);
  return true;
}

// Occupied cores or places; on an accelerator, places of shadow jobs count too.
template <class S>
i64 taken(const S& s, const Server& server) {
  const bool shares = !server.is_cpu && has_below(s, server);
  return server.used + (shares ? s.servers[server.below].used : 0);
}

// Whether a job that fits may start: on an accelerator a shadow job waits for own jobs due soon.
template <class S>
bool may_begin(const S& s, const Server& server, const Site& site, i64 now) {
  return !is_below(s, server) || server.is_cpu || !is_awaited(s, server, site, now);
}

// Assigns the cores of a server that is not fair.
template <class S>
void dispatch(S& s, Server& server, i64 now) {
  if (takes_turns(s, server)) {
    take_turn(s, server, now);
    return;
  }
  if (server.n_wait == 0) return;
  tick(s, server, now);
  while (server.n_wait > 0) {
    const Waiting first = *waiting_of(s, server);
    Job& job = s.job(first.key);
    const Site& site = s.site(job);
    if (taken(s, server) + site.need <= server.cores) {
      if (!may_begin(s, server, site, now)) break;
      pop(waiting_of(s, server), server.n_wait--);
      start(s, server, site, first.key, job, first.left_ns, now);
    } else if (server.scheduler != kPriority || !preempt(s, server, first)) {
      break;
    }
  }
}

// Removes a job from a heap of n running jobs; returns its row.
[[gnu::noinline]] inline Running remove(Running* jobs, i64 n, i64 key) {
  i64 at = 0;
  while (jobs[at].key != key) ++at;
  const Running row = jobs[at];
  pop(jobs, n, at);
  return row;
}

// Removes a job that has finished from a server.
template <class S>
void leave(S& s, Server& server, const Site& site, i64 key, i64 now) {
  const i64 elapsed = account(s, server, now);
  const i64 n = server.n_run;
  // The virtual clock of an empty server is reset with its next job.
  if (n > 1 || counts_beside(s, server)) advance_clock(s, server, elapsed);
  note_beside(s, server, remove(running_of(s, server), n, key));
  server.n_run -= 1;
  if (takes_turns(s, server)) {
    server.used -= 1;
    end_turn(s.quotas[server.quota]);
  } else {
    server.used -= site.need;
  }
  server.next_key = -1;
  const bool is_pair = is_below(s, server) || is_shared(s, server);
  if (n > 1 || server.n_wait > 0 || has_quota(s, server) || is_pair) mark(s, server);
  if (server.scheduler == kFair) set_speed(s, server);
}

// Makes a job that a worker has taken runnable.
template <class S>
void admit(S& s, i64 key, i64 now) {
  Job& job = s.job(key);
  const Site& site = s.site(job);
  Server& server = s.server(site);
  const i64 work_ns = site.exec_ns[cycle_of(key)];
  S::fetch_next(site.exec_ns[cycle_of(key)]);
  if (takes_turns(s, server)) {
    line_up(s, server, job, key, work_ns, now);
    return;
  }
  const f64 left = time_alone(site, work_ns);
  // If no other job can want the cores now, skip the queue.
  const bool alone = server.n_wait == 0 && s.n_ready == 1;
  const bool fits = alone && !is_below(s, server) && taken(s, server) + site.need <= server.cores;
  if (has_quota(s, server)) {
    tick(s, server, now);
    refill(s, server, now);
  }
  if (server.scheduler != kFair && !fits) {
    mark(s, server);
    queue_up(s, server, Waiting{rank_of(server, site), job.ready_ns, key, left});
    return;
  }
  tick(s, server, now);
  start(s, server, site, key, job, left, now);
  if (is_below(s, server) || is_shared(s, server)) {
    mark(s, server);
    if (is_below(s, server)) return;
  }
  if (server.scheduler == kFair) set_speed(s, server);
  if (server.is_dirty & kIsDirty) return;
  const bool lone = server.n_run == 1 && !has_quota(s, server);
  if (lone && server.speed == 1.0 && left == static_cast<f64>(work_ns)) {
    announce(s, server, later(now, work_ns), key);
  } else {
    schedule(s, server, now);
  }
}

}  // namespace dwell
