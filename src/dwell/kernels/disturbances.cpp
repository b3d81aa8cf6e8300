// What nodes and links go through: the disturbances of each, which come and go, merged in time.

#include <algorithm>
#include <cstdint>
#include <utility>

#include "export.h"
#include "on_off_intervals.h"
#include "rows.h"

namespace dwell {
namespace {

// What one disturbance does to a node; disturbances.py has the same struct.
struct NodeEffect {
  OnOffIntervals intervals;
  int64_t node;
  int64_t down;
  int64_t threads[kLevels];
};
static_assert(sizeof(NodeEffect) == 312);

struct NodeState {
  int64_t threads;
  int64_t down;  // effects by which it is down
};

// What one disturbance does to a link; disturbances.py has the same struct.
struct LinkFault {
  OnOffIntervals intervals;
  int64_t down;
  int64_t layers[kLevels];
  double arriving[kLevels];  // share of the attempts that it does not lose
  double rate_mbps[kLevels];
};
static_assert(sizeof(LinkFault) == 816);

bool before(const NodeEffect& one, const NodeEffect& other) noexcept {
  const int64_t at_ns = one.intervals.next_ns();
  const int64_t other_ns = other.intervals.next_ns();
  return at_ns != other_ns ? at_ns < other_ns : one.node < other.node;
}

// Moves the effect at i of a binary heap down until none below it changes sooner.
void sift_down(NodeEffect** heap, int64_t count, int64_t i) noexcept {
  for (int64_t below = 2 * i + 1; below < count; below = 2 * i + 1) {
    if (below + 1 < count && before(*heap[below + 1], *heap[below])) ++below;
    if (!before(*heap[below], *heap[i])) return;
    std::swap(heap[i], heap[below]);
    i = below;
  }
}

}  // namespace

// Merges the effects of all nodes up to an instant; returns the number of changes.
DWELL_EXPORT int64_t dwell_node_changes(NodeEffect** effects, int64_t count, int64_t last_ns,
                                        NodeState* nodes, Change* changes) noexcept {
  for (int64_t i = count / 2; i-- > 0;) sift_down(effects, count, i);
  int64_t made = 0;
  while (count > 0 && effects[0]->intervals.next_ns() <= last_ns) {
    NodeEffect& next = *effects[0];
    const int64_t at_ns = next.intervals.next_ns();
    const int64_t sign = next.intervals.on() ? -1 : 1;
    NodeState& state = nodes[next.node];
    state.threads += sign * next.threads[next.intervals.level()];
    state.down += sign * next.down;
    // Of what changes at one instant, the node's state after all of it counts.
    const bool again =
        made > 0 && changes[made - 1].at_ns == at_ns && changes[made - 1].node == next.node;
    made += again ? 0 : 1;
    changes[made - 1] = {at_ns, next.node, state.threads, state.down > 0 ? 1 : 0};
    ++next.intervals.passed;
    sift_down(effects, count, 0);
  }
  return made;
}

// Merges the faults of one link, whose own state is given as its first segment; returns the number
// of segments.
DWELL_EXPORT int64_t dwell_link_segments(LinkFault* faults, int64_t count, Segment* segments,
                                         Rate* rates) noexcept {
  const Segment own = segments[0];
  const Rate own_rate = rates[0];
  int64_t made = 0;
  for (int64_t at_ns = 0; at_ns != kAtNoTime;) {
    Segment segment = own;
    segment.at_ns = at_ns;
    double rate_mbps = own_rate.rate_mbps;
    double arriving = 1.0 - own_rate.loss;
    int64_t next_ns = kAtNoTime;
    for (int64_t i = 0; i < count; ++i) {
      LinkFault& fault = faults[i];
      OnOffIntervals& intervals = fault.intervals;
      while (intervals.next_ns() <= at_ns) ++intervals.passed;
      next_ns = std::min(next_ns, intervals.next_ns());
      if (!intervals.on()) continue;
      const int64_t level = intervals.level();
      segment.is_down |= fault.down;
      segment.layers |= fault.layers[level];
      arriving *= fault.arriving[level];
      rate_mbps = std::min(rate_mbps, fault.rate_mbps[level]);
    }
    segments[made] = segment;
    rates[made] = {rate_mbps, 1.0 - arriving};
    ++made;
    at_ns = next_ns;
  }
  return made;
}

}  // namespace dwell
