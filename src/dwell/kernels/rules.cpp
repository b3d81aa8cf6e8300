// Decisions of built-in policies.

#include "rules.h"

#include <cmath>
#include <limits>

#include "windows.h"

namespace dwell {
namespace {

// A resource is saturated from this share on: measurements cannot show any further demand.
constexpr f64 kSaturated = 0.995;
// J decides between candidates whose relative excess is this close to the least.
constexpr f64 kExcessTolerance = 1e-6;

// U_r, U_e and U_c.
struct Used {
  f64 tier[kNoTier];
};

// The numbers of one decision: one column per candidate, in the order of the table of decisions.
struct Priced {
  const Tables& s;
  const Seen& seen;
  f64* row;
  const i64 n, n_resources;

  Priced(const Tables& tables, const Seen& of, i64 decision)
      : s(tables),
        seen(of),
        row(&s.priced[decision * s.clock[0].n_priced]),
        n(s.options.size),
        n_resources(s.cells[0].n_resources) {}

  f64& j(i64 c) { return row[c]; }
  f64& l95_ms(i64 c) { return row[n + c]; }
  f64& violation_rate(i64 c) { return row[2 * n + c]; }
  f64& used(i64 resource, i64 c) { return row[(3 + resource) * n + c]; }
  f64& is_within(i64 c) { return row[(3 + n_resources) * n + c]; }
  f64& excess(i64 c) { return row[(4 + n_resources) * n + c]; }

  f64 uncut_ms(i64 c) const {
    return c == s.rule[0].incumbent ? seen.uncut_ms : s.options[c].uncut_ms;
  }
  // Utilisation of the busiest resource; a saturated resource counts as full.
  f64 busiest(i64 c) {
    f64 largest = 0.0;
    for (i64 i = 0; i < n_resources; ++i) largest = std::max(largest, used(i, c));
    return largest < kSaturated ? largest : std::max(largest, 1.0);
  }
};

f64 price(const Tables& s, f64 l95_ms, f64 violation_rate, const Used& used, f64 switching) {
  const Rule& r = s.rule[0];
  f64 j = r.weight_latency * (l95_ms / r.target_ms) + r.weight_violations * violation_rate +
          r.weight_robot * (used.tier[kRobot] / r.target_robot) +
          r.weight_edge * (used.tier[kEdge] / r.target_edge);
  if (r.target_cloud > 0.0) j = j + r.weight_cloud * (used.tier[kCloud] / r.target_cloud);
  return j + r.weight_switching * switching;
}

Used used_by_tiers(Priced& priced, i64 candidate) {
  Used used{};
  for (i64 i = 0; i < priced.n_resources; ++i) {
    const i8 tier = priced.s.tiers[i];
    if (tier == kNoTier) continue;
    used.tier[tier] = std::max(used.tier[tier], priced.used(i, candidate));
  }
  return used;
}

// Estimates every candidate from its profile, and adds the measured utilisation of others. The
// incumbent's utilisation is measured over the cycles that the decision looks at.
void estimate(Priced& priced, const f64* recent, const f64* observed) {
  const f64 *used = recent, *own = used + priced.s.clock[0].n_resources;
  const f64* shadow = own + priced.s.clock[0].n_resources;
  const Tables& s = priced.s;
  const i64 incumbent = s.rule[0].incumbent, n = priced.n;
  for (i64 c = 0; c < n; ++c) {
    priced.l95_ms(c) = s.options[c].l95_ms;
    priced.violation_rate(c) = s.options[c].violation_rate;
  }
  for (i64 i = 0; i < priced.n_resources; ++i) {
    const f64 busy = used[i], mine = own[i] + shadow[i];
    f64* shown = &s.shown[i * n];
    if (busy < kSaturated) {
      std::fill(shown, shown + n, 1.0);
      shown[incumbent] = busy;
    } else {
      shown[incumbent] = 1.0;
    }
    const bool hides = busy >= kSaturated && mine < kSaturated;
    const f64 foreign = busy - mine > 0.0 ? busy - mine : 0.0;
    for (i64 c = 0; c < n; ++c) {
      const f64 expected = std::min(foreign + s.work[c * priced.n_resources + i], 1.0);
      priced.used(i, c) = hides ? shown[c] : expected;
    }
    priced.used(i, incumbent) = observed[i];
  }
}

// Largest relative excess of a candidate over a cap; negative if it is within all caps.
f64 excess(Priced& priced, i64 candidate) {
  const Rule& rule = priced.s.rule[0];
  const f64 latency = std::isinf(rule.cap_ms) ? 0.0 : priced.uncut_ms(candidate) / rule.cap_ms;
  return std::max(latency, priced.busiest(candidate) / rule.cap_utilisation) - 1.0;
}

// Eligible candidates: all within the caps, or, if no candidate is, all with the least excess.
struct Eligible {
  Priced& priced;
  bool within_caps = false;
  f64 most;

  explicit Eligible(Priced& of) : priced(of), most(std::numeric_limits<f64>::infinity()) {
    for (i64 c = 0; c < priced.n; ++c) {
      within_caps = within_caps || is_within(c);
      most = std::min(most, priced.excess(c));
    }
    most += kExcessTolerance;
  }

  bool has(i64 c) const { return within_caps ? is_within(c) : priced.excess(c) <= most; }

 private:
  bool is_within(i64 c) const {
    const Rule& rule = priced.s.rule[0];
    return priced.uncut_ms(c) <= rule.cap_ms && priced.busiest(c) <= rule.cap_utilisation;
  }
};

// dwell.cost.exceeds.
bool exceeds(const Rule& rule, f64 gain, f64 threshold) {
  return gain > threshold + rule.gain_tolerance;
}

struct Choice {
  i64 placement;
  Reason reason;
  f64 delta_j;
};

// The cheapest of some candidates; the incumbent wins every tie.
template <class Among>
i64 cheapest(Priced& priced, Among is_among) {
  const i64 incumbent = priced.s.rule[0].incumbent;
  i64 best = -1;
  f64 lowest = std::numeric_limits<f64>::infinity();
  for (i64 c = 0; c < priced.n; ++c) {
    if (!is_among(c)) continue;
    const f64 j = priced.j(c);
    if (j < lowest || (c == incumbent && j == lowest)) {
      best = c;
      lowest = j;
    }
  }
  return best;
}

// Reason for a move to a candidate.
Reason reason_of(Priced& priced, i64 best, const Eligible& eligible) {
  if (!eligible.within_caps) return kInfeasible;
  for (i64 c = 0; c < priced.n; ++c) {
    if (priced.j(c) < priced.j(best) && !eligible.has(c)) return kCapped;
  }
  return kMove;
}

// dwell.policies.dtp.
Choice decide_dtp(Priced& priced, f64 measured) {
  const Rule& rule = priced.s.rule[0];
  const Eligible eligible(priced);
  const i64 best = cheapest(priced, [&](i64 c) { return eligible.has(c); });
  const f64 delta_j = measured - priced.j(best);
  if (rule.escape && priced.excess(rule.incumbent) > 0.0 && eligible.within_caps) {
    return {best, reason_of(priced, best, eligible), delta_j};
  }
  if (rule.dwell < rule.min_dwell) return {rule.incumbent, kDwell, NAN};
  if (best != rule.incumbent && exceeds(rule, delta_j, rule.min_improvement)) {
    return {best, reason_of(priced, best, eligible), delta_j};
  }
  return {rule.incumbent, eligible.within_caps ? kHold : kInfeasible, delta_j};
}

// dwell.policies.cusum; `alone` is J of the window without its switching term.
Choice decide_cusum(Priced& priced, f64 alone) {
  const Tables& s = priced.s;
  const Rule& rule = s.rule[0];
  const Eligible eligible(priced);
  for (i64 c = 0; c < priced.n; ++c) {
    const f64 gain = alone - priced.j(c) - rule.slack;
    f64& sum = s.options[c].sum;
    sum = c == rule.incumbent ? 0.0 : std::max(0.0, rule.memory * sum + gain);
  }
  const i64 best = cheapest(priced, [&](i64 c) {
    return eligible.has(c) && exceeds(rule, s.options[c].sum, rule.threshold);
  });
  const Reason holds = eligible.within_caps ? kHold : kInfeasible;
  if (best < 0) return {rule.incumbent, holds, 0.0};
  const f64 delta_j = alone - priced.j(best);
  if (!exceeds(rule, delta_j, 0.0)) return {rule.incumbent, holds, delta_j};
  for (i64 c = 0; c < priced.n; ++c) s.options[c].sum = 0.0;
  return {best, reason_of(priced, best, eligible), delta_j};
}

// dwell.policies.latency_first.
Choice decide_latency_first(Priced& priced) {
  const Rule& rule = priced.s.rule[0];
  i64 best = rule.incumbent;
  for (i64 c = 0; c < priced.n; ++c) {
    if (priced.l95_ms(c) < priced.l95_ms(best)) best = c;
  }
  const f64 saved_ms = priced.l95_ms(rule.incumbent) - priced.l95_ms(best);
  if (!exceeds(rule, saved_ms, 0.0)) return {rule.incumbent, kHold, NAN};
  return {best, kMove, NAN};
}

// dwell.policies.atp.
Choice decide_atp(Priced& priced) {
  const Tables& s = priced.s;
  Rule& rule = s.rule[0];
  const i64 incumbent = rule.incumbent;
  const bool on_robot = s.options[incumbent].on_robot != 0;
  const i64 other = on_robot ? rule.offload : rule.local;
  const Used here = used_by_tiers(priced, incumbent), there = used_by_tiers(priced, other);
  rule.n_shown += 1;
  rule.shown_ms += priced.l95_ms(incumbent);
  rule.shown_robot += here.tier[kRobot];
  rule.shown_edge += here.tier[kEdge];
  rule.shown_cloud += here.tier[kCloud];
  rule.told_ms += priced.l95_ms(other);
  rule.told_robot += there.tier[kRobot];
  rule.told_edge += there.tier[kEdge];
  rule.told_cloud += there.tier[kCloud];
  const bool dwells = rule.dwell < rule.min_dwell;
  if (rule.n_shown < rule.every_windows) return {incumbent, dwells ? kDwell : kHold, NAN};
  const f64 n = static_cast<f64>(rule.n_shown);
  const f64 ms = rule.shown_ms / n, told_ms = rule.told_ms / n;
  const Used shown{{rule.shown_robot / n, rule.shown_edge / n, rule.shown_cloud / n}};
  const Used told{{rule.told_robot / n, rule.told_edge / n, rule.told_cloud / n}};
  rule.n_shown = 0;
  rule.shown_ms = rule.shown_robot = rule.shown_edge = rule.shown_cloud = 0.0;
  rule.told_ms = rule.told_robot = rule.told_edge = rule.told_cloud = 0.0;
  if (dwells) return {incumbent, kDwell, NAN};
  const f64 outside = shown.tier[rule.outside_is_cloud ? kCloud : kEdge];
  const bool is_busy =
      on_robot ? shown.tier[kRobot] > rule.most_robot : outside > rule.most_outside;
  if (!(ms > rule.most_ms || is_busy)) return {incumbent, kHold, NAN};
  const f64 moved = s.switching[incumbent * priced.n + other];
  const f64 saved = price(s, ms, 0.0, shown, 0.0) - price(s, told_ms, 0.0, told, moved);
  if (exceeds(rule, saved, 0.0)) return {other, kMove, saved};
  return {incumbent, kHold, saved};
}

Choice choose(Priced& priced, f64 measured, f64 alone) {
  const i64 incumbent = priced.s.rule[0].incumbent;
  switch (static_cast<Policy>(priced.s.rule[0].policy)) {
    case kDtp:
      return decide_dtp(priced, measured);
    case kCusum:
      return decide_cusum(priced, alone);
    case kLatencyFirst:
      return decide_latency_first(priced);
    case kAtp:
      return decide_atp(priced);
    case kStatic:
      break;
  }
  return {incumbent, kHold, NAN};
}

}  // namespace

bool decide(const Tables& s, i64 decision) {
  Rule& rule = s.rule[0];
  const Cell& cell = s.cells[0];
  const i64 incumbent = rule.incumbent, n = s.options.size;
  const bool is_window = cell.decide_cycles == 0;
  Priced priced(s, is_window ? s.seen[decision] : s.looked[decision], decision);
  const f64* recent = is_window ? &s.shares[snapshot_row(s, 0, decision)]
                                : &s.look_shares[look_row(s, 0, decision, 0)];
  estimate(priced, recent, is_window ? recent : &s.look_shares[look_row(s, 0, decision, 1)]);
  const f64 n_cycles = static_cast<f64>(priced.seen.cycles);
  priced.l95_ms(incumbent) = priced.seen.l95_ms;
  priced.violation_rate(incumbent) = static_cast<f64>(priced.seen.missed) / n_cycles;
  for (i64 c = 0; c < n; ++c) {
    priced.excess(c) = excess(priced, c);
    priced.is_within(c) = priced.excess(c) <= 0.0;
    priced.j(c) = NAN;
    if (!rule.is_priced) continue;
    priced.j(c) = price(s, priced.l95_ms(c), priced.violation_rate(c), used_by_tiers(priced, c),
                        s.switching[incumbent * n + c]);
  }
  const Used used = used_by_tiers(priced, incumbent);
  const f64 moved = s.switching[rule.previous * n + incumbent];
  const f64 l95_ms = priced.l95_ms(incumbent), rate = priced.violation_rate(incumbent);
  const f64 measured = price(s, l95_ms, rate, used, moved);
  const f64 alone = price(s, l95_ms, rate, used, 0.0);
  const Choice choice = choose(priced, measured, alone);
  const bool moves = choice.placement != incumbent;
  rule.dwell = moves ? 0 : rule.dwell + 1;
  rule.previous = incumbent;
  rule.incumbent = choice.placement;
  s.decided[decision] = Decided{choice.delta_j, rule.dwell, static_cast<i32>(incumbent),
                                static_cast<i32>(choice.placement), choice.reason};
  return !moves;
}

void stamp_next(const Tables& s) {
  const Cell& cell = s.cells[0];
  Rule& rule = s.rule[0];
  i64 reach = cell.decide_cycles == 0 ? cell.close_cycle : cell.look_cycle;
  if (reach <= cell.n_cycles) {
    const i64 closed_ns = close_ns(cell, reach - 1);
    if (closed_ns > cell.release_ns[reach]) {
      while (reach <= cell.n_cycles && cell.release_ns[reach] <= closed_ns) ++reach;
    }
  }
  const i16 stamp = static_cast<i16>(rule.incumbent);
  for (i64 cycle = rule.stamped; cycle < std::min(reach, cell.n_cycles); ++cycle) {
    s.stamps[cycle] = stamp;
  }
  rule.stamped = reach;
}

}  // namespace dwell
