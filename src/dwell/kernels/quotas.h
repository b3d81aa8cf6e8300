// Quotas of servers: the instants at which they are used up and renewed.
#pragma once

#include <cmath>

#include "attempts.h"
#include "servers.h"

namespace dwell {

template <class S>
void notice(S& s, Server& server, Quota& quota, i64 now);
template <class S>
void strike(S& s, Server& server, Quota& quota, i64 now);
template <class S>
i64 next_look(S& s, Server& server, Quota& quota, i64 now);

// Whether a quota fills a pool, from which the server draws.
template <class S>
bool is_pooled(const S& s, const Server& server, const Quota& quota) {
  return quota.slack_ns > 0 || takes_turns(s, server);
}

// Fills a server's bucket, or the pool of its quota, if a period has begun.
template <class S>
void renew(S& s, Server& server, Quota& quota, i64 now) {
  const i64 period = (now + quota.period_ago_ns) / quota.period_ns;
  if (period <= quota.period) return;
  quota.period = period;
  i64& filled = is_pooled(s, server, quota) ? quota.pool_ns : quota.left_ns;
  filled = server.stress > 0 ? quota.stressed_ns : quota.quota_ns;
}

// Renews a server's quota for past periods, before the server's foreign threads change.
//
// Without a pool, events at the first instant of a period precede the period.
template <class S>
void renew_before_stress(S& s, Server& server, i64 now) {
  if (!has_quota(s, server)) return;
  Quota& quota = s.quotas[server.quota];
  if (is_pooled(s, server, quota)) {
    renew(s, server, quota, now);
    return;
  }
  renew(s, server, quota, now - 1);
  // If a job of this instant has already begun the period, begin it again; it is still unused.
  const i64 period = now / quota.period_ns;
  if (period > 0 && period * quota.period_ns == now) quota.period = period - 1;
}

// Stops a server if its quota is used up, else lets it run; its clock must be up to date.
//
// While jobs or threads run there is an event at every begin of a period and whenever the quota is
// used up; all core time between two events therefore belongs to one period. With a slack the quota
// fills a pool, and a busy server draws the full pool whenever its share is used up.
template <class S>
void refill(S& s, Server& server, i64 now) {
  Quota& quota = s.quotas[server.quota];
  renew(s, server, quota, now);
  server.is_stopped = quota.left_ns <= 0;
  set_speed(s, server);
}

// Draws from the pool if the previous share is used up; the clock must be up to date.
//
// Called after all changes of this instant: a job that ends now draws nothing.
template <class S>
void draw_quota(S& s, Server& server, i64 now) {
  Quota& quota = s.quotas[server.quota];
  if (takes_turns(s, server)) {
    strike(s, server, quota, now);
    return;
  }
  refill(s, server, now);
  const bool is_busy = server.used + server.stress + lent(s, server) > 0;
  if (quota.left_ns <= 0 && is_busy && !server.is_down) {
    quota.left_ns += quota.pool_ns;
    quota.pool_ns = 0;
    refill(s, server, now);
  }
}

// Announces when a server's quota is used up or renewed; older announcements become invalid.
template <class S>
void announce_quota(S& s, Server& server, i64 now) {
  Quota& quota = s.quotas[server.quota];
  const bool turns = takes_turns(s, server);
  if (turns) {
    notice(s, server, quota, now);
  } else {
    refill(s, server, now);
  }
  const i64 busy = server.used + server.stress;
  if (busy + lent(s, server) == 0 || server.is_down) {
    quota.looks_ns = -1;
    // Return the unused share beyond the slack to the pool.
    if (is_pooled(s, server, quota) && quota.left_ns > quota.slack_ns) {
      const i64 pool_ns = quota.pool_ns + quota.left_ns - quota.slack_ns;
      quota.pool_ns = std::min(pool_ns, quota.quota_ns);
      quota.left_ns = quota.slack_ns;
    }
    return;
  }
  i64 at_ns = (quota.period + 1) * quota.period_ns;
  if (turns) {
    at_ns = next_look(s, server, quota, now);
  } else if (!server.is_stopped) {
    const i64 rate = std::min(busy, server.cores) + lent(s, server);
    at_ns = std::min(at_ns, now + (quota.left_ns + rate - 1) / rate);
  } else if (quota.pool_ns > 0) {
    at_ns = now;
  }
  if (at_ns == quota.looks_ns) return;
  quota.looks_ns = at_ns;
  // Item 0 is a change of a node; the item of a server's quota is the server's row plus 1.
  s.post(at_ns, make_key(kChange, 0, 0, &server - s.servers.rows + 1));
}

// Handles a server's quota that is used up or renewed, unless the announcement is invalid.
template <class S>
void look_at_quota(S& s, Server& server, i64 now) {
  Quota& quota = s.quotas[server.quota];
  if (quota.looks_ns != now) return;
  quota.looks_ns = -1;
  tick(s, server, now);
  draw_quota(s, server, now);
  mark(s, server);
}

}  // namespace dwell
