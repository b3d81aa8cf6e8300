// Links: serialisation at the rate in order of sending, then a delay that may overtake.
#pragma once

#include <cmath>
#include <limits>

#include "attempts.h"
#include "order.h"

namespace dwell {

// Linux's least TCP retransmission timeout: lost state is sent again after this time on links that
// have no timeout.
constexpr i64 kStateTimeoutNs = 200'000'000;

// Instant at which the link can take a message; updates the link's current segment.
//
// A link that drops messages takes and loses them even while it is down. A link that retransmits
// holds a message back until the end of the outage.
template <class S>
i64 begin(const S& s, Link& link, i64 now) {
  i64 start = std::max(now, link.free_ns);
  const i64 last = link.segment_end - 1;
  i64 segment = link.segment;
  while (segment < last && s.segments[segment + 1].at_ns <= start) ++segment;
  if (link.retransmit_ns >= 0) {
    while (segment < last && s.segments[segment].is_down) start = s.segments[++segment].at_ns;
  }
  link.segment = segment;
  return start;
}

// Time that a message takes at the rate of a link.
inline i64 transmission_ns(const Hop& hop, const Rate& rate) {
  if (rate.rate_mbps == std::numeric_limits<f64>::infinity()) return 0;
  return whole_ns(std::rint(static_cast<f64>(hop.payload_bytes) * 8000.0 / rate.rate_mbps));
}

// Transmits a message at the rate of a link; returns the end. The message has its price, also if it
// is lost later. A cell pays for its shadow.
template <class S>
i64 transmit(S& s, i64 cell, const Hop& hop, Link& link, const Rate& rate, i64 start) {
  link.free_ns = later(start, transmission_ns(hop, rate));
  if (s.paid.size > 0) {
    const i64 parent = s.cell(cell).parent;
    s.cell(parent < 0 ? cell : parent).paid += hop.price;
  }
  return link.free_ns;
}

// Whether an attempt to send a message is lost.
inline bool loses(const Hop& hop, const Rate& rate, i64 cycle, i64 attempt) {
  return rate.loss > 0.0 && attempt_uniform(hop.loss_key, cycle, attempt) < rate.loss;
}

// Delay of a message, with the extra delays of active layers.
template <class S>
i64 propagation_ns(const S& s, i64 hop, const Segment& segment, i64 cycle) {
  i64 delay = s.hops[hop].delay_ns[cycle];
  S::fetch_next(s.hops[hop].delay_ns[cycle]);
  const Times* layer = &s.layers[hop * s.clock[0].n_layers];
  for (i64 on = segment.layers; on != 0; on >>= 1, ++layer) {
    if ((on & 1) == 0) continue;
    delay = later(delay, (*layer)[cycle]);
    S::fetch_next((*layer)[cycle]);
  }
  return delay;
}

// Loses a message at the begin of its transmission.
template <class S>
[[gnu::noinline]] void lose_message(S& s, i64 cell, i64 cycle, i64 flow, Outcome outcome, i64 at_ns,
                                    i64 now) {
  if (at_ns > now) {
    s.post(at_ns, make_key(kArrival, cell, cycle, flow | kLostOnLink));
    return;
  }
  s.slot(cell, cycle).live -= 1;
  lose_input(s, cell, cycle, flow, outcome);
}

// Sends one message of a flow for the first time (attempt 0) or once more.
template <class S>
void send(S& s, i64 cell, i64 cycle, i64 flow, i64 hop_row, i64 attempt, i64 now) {
  const i64 key = make_key(kArrival, cell, cycle, flow);
  const Hop& hop = s.hops[hop_row];
  Link& link = s.links[hop.link];
  const i64 start = begin(s, link, now);
  const Segment& segment = s.segments[link.segment];
  const Rate& rate = s.rates[link.segment];
  i64 sent = start;
  bool is_lost = segment.is_down != 0;
  if (!is_lost) {
    sent = transmit(s, cell, hop, link, rate, start);
    is_lost = loses(hop, rate, cycle, attempt);
  }
  if (!is_lost) {
    const i64 arrival = later(sent, propagation_ns(s, hop_row, segment, cycle));
    post_arrival(s, hop.link, key, arrival, attempt > 0);
  } else if (link.retransmit_ns < 0) {
    lose_message(s, cell, cycle, flow, kDropped, start, now);
  } else if (segment.is_down) {
    // The link holds messages back and is down for good: the message never arrives.
    lose_message(s, cell, cycle, flow, kInFlight, now, now);
    lose_behind(s, key);
  } else {
    if (link.in_order && attempt == 0) hold(s, hop.link, key, kUnknown);
    s.attempts[s.slot_row(cell, cycle) * s.n_flows + flow] = attempt;
    s.post(later(sent, link.retransmit_ns), make_key(kRetry, cell, cycle, flow));
  }
}

// Instant of the next attempt to send the state of a task, -1 for none, and the attempt's number.
struct StateAttempt {
  i64 at_ns;
  i64 number;  // a wait for the end of an outage does not count
};

// Attempts to send the state of a task that moves, reliably on every link; posts its arrival.
template <class S>
StateAttempt send_state(S& s, i64 hop_row, i64 cycle, i64 attempt, i64 key, i64 now) {
  const Hop& hop = s.hops[hop_row];
  Link& link = s.links[hop.link];
  const i64 start = begin(s, link, now);
  const Segment& segment = s.segments[link.segment];
  const Rate& rate = s.rates[link.segment];
  if (segment.is_down) {
    for (i64 following = link.segment + 1; following < link.segment_end; ++following) {
      if (!s.segments[following].is_down) return {s.segments[following].at_ns, attempt};
    }
    lose_behind(s, key);
    return {-1, attempt};
  }
  const i64 sent = transmit(s, cell_of(key), hop, link, rate, start);
  if (loses(hop, rate, cycle, attempt)) {
    if (link.in_order && attempt == 0) hold(s, hop.link, key, kUnknown);
    const i64 timeout = link.retransmit_ns >= 0 ? link.retransmit_ns : kStateTimeoutNs;
    return {later(sent, timeout), attempt + 1};
  }
  const i64 arrival = later(sent, propagation_ns(s, hop_row, segment, cycle));
  post_arrival(s, hop.link, key, arrival, attempt > 0);
  return {-1, attempt};
}

}  // namespace dwell
