// Times of jobs and messages from the instants of a window's cycles, by part: a task on a node, or
// a flow on a link.

#include <algorithm>
#include <cmath>
#include <limits>

#include "codes.h"
#include "export.h"

namespace dwell {

// A message on a link: its send instant, its transmission time, and its time so far.
struct Crossing {
  i64 link, sent_ns, number;  // in the order in which messages are found
  i64 arrived_ns, repeats;
  f64 cost_ns;
  f64* ms;

  bool operator<(const Crossing& other) const {
    if (link != other.link) return link < other.link;
    return sent_ns != other.sent_ns ? sent_ns < other.sent_ns : number < other.number;
  }
};

namespace {

// Messages that waited for the same message arrive within this time of each other.
constexpr i64 kTogetherNs = 100'000;

void add(Found& found, i64 part, f64 ms) {
  if (found.count[part] == 0) found.order[found.n_parts++] = part;
  found.ms[part * found.most + found.count[part]++] = ms;
}

// Whether the last decision has counted a job or message of an earlier cycle: it had ended, or it
// had begun so long before that it counted as lost.
bool is_counted(const Found& found, i64 begin_ns, i64 end_ns, i64 limit_ns) {
  if (found.counted_ns < 0) return false;
  return (end_ns >= 0 && end_ns <= found.counted_ns) || begin_ns < limit_ns - found.passed_ns;
}

// Adds the time between two instants, or infinity for a job or message that began before the limit
// and has not ended; one that began later, or not at all, is unknown. Returns whether it has ended.
bool add_span(Found& found, i64 part, i64 begin_ns, i64 end_ns, i64 limit_ns) {
  if (is_counted(found, begin_ns, end_ns, limit_ns)) return false;
  if (begin_ns >= 0 && end_ns >= 0) {
    add(found, part, static_cast<f64>(end_ns - begin_ns) / 1e6);
    return true;
  }
  if (begin_ns >= 0 && begin_ns < limit_ns && end_ns != kNotDue) {
    add(found, part, std::numeric_limits<f64>::infinity());
  }
  return false;
}

// The delay of a message that waited for an earlier message: the last earlier delay on the link
// that is no larger than its own time.
f64 last_delay_within(const Crossing* crossing, const Crossing* first) {
  for (const Crossing* other = crossing; other != first;) {
    --other;
    if (other->link != crossing->link) break;
    if (*other->ms <= *crossing->ms) return *other->ms;
  }
  return *crossing->ms;
}

// Subtracts the transmission times of messages, and their waits for other messages of the cell.
void take_off_waits(const Found& found) {
  std::sort(found.crossings, found.crossings + found.n_crossings);
  i64 link = -1, last_ns = 0;
  f64 free_ns = 0.0;
  for (i64 i = 0; i < found.n_crossings; ++i) {
    const Crossing& crossing = found.crossings[i];
    const f64 sent_ns = static_cast<f64>(crossing.sent_ns);
    if (crossing.link != link) {
      free_ns = sent_ns;
      last_ns = std::numeric_limits<i64>::min();
    }
    link = crossing.link;
    free_ns = std::max(free_ns, sent_ns) + crossing.cost_ns;
    // A message that arrived before `free_ns` used a link that is faster than known.
    *crossing.ms = std::max(*crossing.ms - (free_ns - sent_ns) / 1e6, 0.0);
    if (crossing.repeats == 0) continue;
    if (crossing.arrived_ns - kTogetherNs <= last_ns) {
      *crossing.ms = last_delay_within(&crossing, found.crossings);
    }
    last_ns = std::max(last_ns, crossing.arrived_ns);
  }
}

// Rounds to whole nanoseconds, the unit of all measurements, to make equal values ties.
void round_all(const Found& found) {
  for (i64 i = 0; i < found.n_parts; ++i) {
    f64* ms = found.ms + found.order[i] * found.most;
    for (i64 k = 0; k < found.count[found.order[i]]; ++k) ms[k] = std::rint(ms[k] * 1e6) / 1e6;
  }
}

// The next candidate of the shadows of cycles under `active`; -1 for none.
i64 next_other(const Window& window, i64 shadow, i64 active, i64 after) {
  i64 next = -1;
  for (i64 i = 0; i < window.n; ++i) {
    const i64* row = window.rows + i * window.width;
    const i64 other = row[shadow];
    if (row[0] == active && other > after && (next < 0 || other < next)) next = other;
  }
  return next;
}

}  // namespace
}  // namespace dwell

using namespace dwell;

// Adds the times, or demands, of the cycles under one candidate, part after part, then the times of
// their shadows by candidate.
DWELL_EXPORT void dwell_meter(const Layout* layout, const Window* window, i64 active, i64 limit_ns,
                              Found* found) noexcept {
  const i64 n_tasks = layout->n_tasks, n_flows = layout->n_flows, n_parts = n_tasks + n_flows;
  const i64 shadow = 1 + 4 * n_tasks + n_flows;  // its first column
  found->n_crossings = 0;
  i64 other = -1;
  do {
    const i64 begin = other < 0 ? 0 : shadow;
    const i64* parts = layout->parts + (other + 1) * n_parts;
    const i8* shared = layout->shared + (other + 1) * n_flows;
    for (i64 column = 0; column < n_parts; ++column) {
      const i64 part = parts[column], flow = column - n_tasks;
      if (part < 0) continue;
      const i64 source = flow < 0 ? 0 : layout->sources[flow];
      const i64 more_ns = found->more_ns == nullptr ? 0 : found->more_ns[part];
      const i64 lost_ns = limit_ns - more_ns;
      // In earlier cycles only the parts of slow tasks count.
      if (found->counted_ns >= 0 && more_ns == 0) continue;
      for (i64 i = 0; i < window->n; ++i) {
        const i64* cycle = window->rows + i * window->width;
        if (cycle[0] != active || (begin > 0 && cycle[begin] != other)) continue;
        const i64 *ready_ns = cycle + begin + 1, *end_ns = ready_ns + n_tasks;
        const i64 *arrived_ns = end_ns + n_tasks, *work_ns = arrived_ns + n_flows;
        if (flow < 0 && found->cost == nullptr) {
          add_span(*found, part, ready_ns[column], end_ns[column], lost_ns);
        } else if (flow < 0) {
          const bool is_known = end_ns[column] > found->counted_ns && work_ns[column] >= 0;
          const f64 cost = found->cost[part];
          if (is_known) add(*found, part, static_cast<f64>(work_ns[column]) * cost / 1e6);
        } else {
          const i64 sent_ns = (shared[flow] ? cycle + 1 + n_tasks : end_ns)[source];
          const bool has_come = add_span(*found, part, sent_ns, arrived_ns[flow], lost_ns);
          if (found->cost == nullptr || found->link[part] < 0 || sent_ns < 0) continue;
          // A lost message may never have occupied the link.
          if (!has_come) continue;
          f64* ms = found->ms + part * found->most + found->count[part] - 1;
          const i64 number = found->n_crossings++;
          found->crossings[number] = {
              found->link[part],    sent_ns,           number, arrived_ns[flow],
              found->repeats[part], found->cost[part], ms};
        }
      }
    }
    other = window->width > shadow ? next_other(*window, shadow, active, other) : -1;
  } while (other >= 0);
  if (found->cost == nullptr) return;
  take_off_waits(*found);
  round_all(*found);
}
