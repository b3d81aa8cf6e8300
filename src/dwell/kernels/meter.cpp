// The times of jobs and messages that the instants of a window's cycles show, by part: a task on a
// node, or a flow on a link.

#include <limits>

#include "export.h"
#include "rows.h"

namespace dwell {
namespace {

// A window's cycles, or their shadows: the candidate that each went through, -1 for none, and its
// instants by task and by flow, -1 for what had not come.
struct Cycles {
  const i64* placement;
  const i64* ready_ns;
  const i64* end_ns;
  const i64* arrived_ns;
};

// What cycles under one candidate go through: the source of each flow, then in row 0 for the cycles
// themselves, in row 1 + i for their shadows through candidate i, the part of each task and of each
// flow, -1 for none of their own, and whether a flow's source is shared with the cycle.
struct Layout {
  i64 n_tasks, n_flows;
  const i64* sources;
  const i64* parts;
  const i8* shared;
};

// The times found: up to `most` of each part, and the parts in the order in which they were found.
struct Found {
  f64* ms;
  i64* count;
  i64* order;
  i64 most, n_parts;
};

void add(Found& found, i64 part, f64 ms) {
  if (found.count[part] == 0) found.order[found.n_parts++] = part;
  found.ms[part * found.most + found.count[part]++] = ms;
}

// Adds what lies between two instants. What has not come is lost if it began before the limit; if
// it began later, or never, nothing is known of it.
void add_span(Found& found, i64 part, i64 begin_ns, i64 end_ns, i64 limit_ns) {
  if (begin_ns >= 0 && end_ns >= 0) {
    add(found, part, static_cast<f64>(end_ns - begin_ns) / 1e6);
  } else if (begin_ns >= 0 && begin_ns < limit_ns) {
    add(found, part, std::numeric_limits<f64>::infinity());
  }
}

// The next candidate that cycles under `active` were also sent through; -1 if there is none.
i64 next_other(const Cycles& cycles, const Cycles& shadows, i64 n, i64 active, i64 after) {
  i64 next = -1;
  for (i64 i = 0; i < n; ++i) {
    const i64 other = shadows.placement[i];
    if (cycles.placement[i] == active && other > after && (next < 0 || other < next)) next = other;
  }
  return next;
}

}  // namespace
}  // namespace dwell

using namespace dwell;

// Adds the times of the cycles under one candidate among `n`, part after part, then those of their
// shadows, if there are any, by candidate.
DWELL_EXPORT void dwell_meter(const Layout* layout, i64 n, i64 active, const Cycles* cycles,
                              const Cycles* shadows, i64 limit_ns, Found* found) noexcept {
  const i64 n_tasks = layout->n_tasks, n_flows = layout->n_flows;
  i64 other = -1;
  do {
    const bool is_own = other < 0;
    const Cycles& through = is_own ? *cycles : *shadows;
    const i64* parts = layout->parts + (other + 1) * (n_tasks + n_flows);
    const i8* shared = layout->shared + (other + 1) * n_flows;
    for (i64 column = 0; column < n_tasks + n_flows; ++column) {
      const i64 part = parts[column], flow = column - n_tasks;
      if (part < 0) continue;
      const Cycles& from = flow >= 0 && shared[flow] ? *cycles : through;
      for (i64 i = 0; i < n; ++i) {
        if (cycles->placement[i] != active || (!is_own && through.placement[i] != other)) continue;
        if (flow < 0) {
          const i64 at = i * n_tasks + column;
          add_span(*found, part, through.ready_ns[at], through.end_ns[at], limit_ns);
        } else {
          const i64 sent_ns = from.end_ns[i * n_tasks + layout->sources[flow]];
          add_span(*found, part, sent_ns, through.arrived_ns[i * n_flows + flow], limit_ns);
        }
      }
    }
    other = shadows == nullptr ? -1 : next_other(*cycles, *shadows, n, active, other);
  } while (other >= 0);
}
