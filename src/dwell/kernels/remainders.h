// Remainders: servers below others, which give shadow jobs the cores that own jobs leave.
//
// Shadow jobs do not delay own jobs, except through a quota or the places of an accelerator. After
// every event on a server its remainder is computed again.
#pragma once

#include "replicas.h"
#include "turns.h"

namespace dwell {

// Cores of a server, fair or in turns, that own jobs leave to shadow jobs and foreign threads.
template <class S>
f64 rest_of(const S& s, const Server& server) {
  if (takes_turns(s, server)) return server.n_run > 0 ? 0.0 : 1.0;
  const f64 own = static_cast<f64>(server.used), foreign = static_cast<f64>(server.stress);
  const f64 load = own + foreign;
  return load <= server.spare ? server.spare - own : server.spare * foreign / load;
}

// Computes the busy cores that the server below adds, and the background that it displaces.
template <class S>
void count_added(const S& s, const Server& server, Server& below) {
  const i64 busy = server.used + server.stress, cores = server.cores;
  const i64 used = busy + below.used;
  below.lent = std::min(used, cores) - std::min(busy, cores);
  below.background = 0.0;
  if (server.background > 0.0 && !has_quota(s, server)) {
    const auto behind = [&](i64 taken) {
      return std::min(server.background, static_cast<f64>(std::max<i64>(cores - taken, 0)));
    };
    below.background = behind(used) - behind(busy);
  }
}

// Assigns the remainder of a server to shadow jobs; own jobs already have their cores.
template <class S>
[[gnu::noinline]] void leave_rest(S& s, Server& server, i64 now) {
  Server& below = s.servers[server.below];
  tick(s, below, now);
  // If shadow jobs affect own jobs, completions of own jobs are announced again after any change.
  if (has_quota(s, server) || !server.is_cpu) tick(s, server, now);
  if (has_quota(s, server) && !takes_turns(s, server)) refill(s, server, now);
  below.stress = server.stress;
  below.is_stopped = server.is_stopped;
  if (below.scheduler == kFair) {
    below.spare = rest_of(s, server);
    set_speed(s, below);
  } else {
    below.cores = server.cores - server.used;
    // Goes before every job, so any job can be preempted.
    const Waiting own{std::numeric_limits<i64>::min(), 0, 0, 0.0};
    while (below.used > below.cores && preempt(s, below, own)) {
    }
    dispatch(s, below, now);
    below.speed = server.speed;
  }
  count_added(s, server, below);
  server.lent = has_quota(s, server) ? below.lent : 0;
  schedule(s, below, now);
}

// Whether an event on a server affects own jobs. A change on the server below does so only if it
// draws on their quota or occupies places.
template <class S>
bool is_concerned(const S& s, const Server& server) {
  return (server.is_dirty & kIsDirty) != 0 || has_quota(s, server) || !server.is_cpu;
}

// Whether an own job may want a place of an accelerator before a shadow job that starts now ends.
template <class S>
bool is_awaited(const S& s, const Server& below, const Site& site, i64 now) {
  const Server& server = s.servers[below.above];
  if (server.n_wait > 0) return true;
  const i64 cell = s.cell(site.cell).parent, end_ns = later(now, site.mean_ns);
  const Cell& of = s.cell(cell);
  const i64 last = of.released - 1;
  for (i64 cycle = last; cycle >= 0 && cycle > last - s.n_slots; --cycle) {
    const Slot& slot = s.slot(cell, cycle);
    for (i64 task = 0; task < of.n_tasks; ++task) {
      const Job& job = s.job(cell, cycle, task);
      if (S::kRates && job.site < 0) continue;
      if (s.site(job).server != below.above) continue;
      const Task& of_job = s.task(cell, task);
      const bool runs = s.is_due(of_job, cycle);
      const i64 soonest_ns = std::max<i64>(s.soonest_ns[slot.candidate * s.n_tasks + task], 0);
      const i64 due_ns = later(of.release_ns[cycle], soonest_ns);
      const i64 next_ns = later(due_ns, of.period_ns);
      if (cycle == last && next_ns < end_ns && s.is_due(of_job, cycle + 1)) return true;
      const bool is_due = runs && due_ns < end_ns && now < next_ns;
      const bool is_over = slot.is_lost != kNothing || job.missing == kHeard;
      if (is_due && job.ready_ns < 0 && !is_over) return true;
    }
  }
  return false;
}

// Updates the least time from a release to the readiness of an own job.
template <class S>
void note_soonest(S& s, i64 cell, i64 cycle, i64 task, i64 now) {
  if (S::kPlain || s.cell(cell).shadow < 0) return;
  i64& soonest_ns = s.soonest_ns[s.slot(cell, cycle).candidate * s.n_tasks + task];
  const i64 since_ns = now - s.cell(cell).release_ns[cycle];
  if (soonest_ns < 0 || since_ns < soonest_ns) soonest_ns = since_ns;
}

// Removes a running or waiting job from a server below another; returns false if it has none.
template <class S>
bool take_off(S& s, Server& server, const Site& site, i64 key, i64 now) {
  for (i64 at = 0; at < server.n_run + server.n_wait; ++at) {
    const bool runs = at < server.n_run;
    const i64 row = runs ? at : at - server.n_run;
    if ((runs ? running_of(s, server)[row].key : waiting_of(s, server)[row].key) != key) continue;
    tick(s, server, now);
    s.own_ns[site.own] += progress(s, server, at).received_ns;
    if (runs) {
      pop(running_of(s, server), server.n_run--, row);
      server.used -= site.need;
      server.next_key = -1;
    } else {
      pop(waiting_of(s, server), server.n_wait--, row);
    }
    mark(s, server);
    return true;
  }
  return false;
}

}  // namespace dwell
