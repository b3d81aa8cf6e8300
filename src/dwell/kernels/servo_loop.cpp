// The reference visual-servo loop; servo_loop.py describes the computation and its arguments.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <initializer_list>

#include "elementary.h"
#include "export.h"

namespace dwell {

// The plant from one actuation on: servo_loop.py has the same columns.
struct Hold {
  double since, position, velocity, acceleration;

  double position_after(double held) const noexcept {
    return position + held * (velocity + 0.5 * acceleration * held);
  }
  double velocity_after(double held) const noexcept { return velocity + acceleration * held; }
};

// Integrals of the error's square and of its absolute value.
struct Integrals {
  double squared, absolute;
};

namespace {

// Status.
constexpr int64_t kDone = 0, kDiverged = 1;

// Halvings of the bracket of a zero before the secant; the error of the integral of |e| falls with
// the square of the bracket.
constexpr int kHalvings = 8;
// Half of w h of the longest piece, and the position beyond which the loop is unstable, in A.
constexpr double kHalfPiece = 0.1;
constexpr double kFar = 1e6;

constexpr double kThird = 1.0 / 3, kFifth = 1.0 / 5, kSeventh = 1.0 / 7, kNinth = 1.0 / 9;

// r(t) = A sin(w t).
struct Target {
  double amplitude, omega;
};

// The error over a piece of a hold; the unit of time is half the piece.
struct Polynomial {
  double c0, c1, c2, c3, c4;

  double at(double t) const noexcept { return c0 + t * (c1 + t * (c2 + t * (c3 + t * c4))); }

  // The integral from 0.
  double area(double to) const noexcept {
    return to * (c0 + to * (0.5 * c1 + to * (kThird * c2 + to * (0.25 * c3 + to * kFifth * c4))));
  }

  Polynomial slope() const noexcept { return {c1, 2 * c2, 3 * c3, 4 * c4, 0.0}; }
};

// The zero between two points with different signs.
double zero(const Polynomial& e, double low, double high) noexcept {
  double at_low = e.at(low), at_high = e.at(high);
  for (int i = 0; i < kHalvings; ++i) {
    const double middle = 0.5 * (low + high);
    const double at_middle = e.at(middle);
    if ((at_middle > 0.0) == (at_high > 0.0)) {
      high = middle;
      at_high = at_middle;
    } else {
      low = middle;
      at_low = at_middle;
    }
  }
  return (low * at_high - high * at_low) / (at_high - at_low);
}

// The integral of |e| from -1 to 1; e has one extremum at most.
double integral_of_absolute(const Polynomial& e) noexcept {
  const double even = e.c0 + e.c2 + e.c4, odd = e.c1 + e.c3;
  const double slope_even = e.c1 + 3 * e.c3, slope_odd = 2 * e.c2 + 4 * e.c4;
  const bool turns = slope_even * slope_even < slope_odd * slope_odd;
  if (even * even >= odd * odd && !turns) {
    return std::fabs(2.0 * (e.c0 + kThird * e.c2 + kFifth * e.c4));
  }
  double start = -1.0, at_start = even - odd, before = e.area(-1.0), total = 0.0;
  for (const double stop : {turns ? zero(e.slope(), -1.0, 1.0) : 1.0, 1.0}) {
    const double at_stop = e.at(stop);
    if ((at_start > 0.0) != (at_stop > 0.0)) {
      const double area = e.area(zero(e, start, stop));
      total += std::fabs(area - before);
      before = area;
    }
    const double area = e.area(stop);
    total += std::fabs(area - before);
    before = area;
    start = stop;
    at_start = at_stop;
  }
  return total;
}

// The integral of e^2 from -1 to 1.
double integral_of_square(const Polynomial& e) noexcept {
  return 2.0 * (e.c0 * e.c0 + kThird * (e.c1 * e.c1 + 2.0 * e.c0 * e.c2) +
                kFifth * (e.c2 * e.c2 + 2.0 * (e.c0 * e.c4 + e.c1 * e.c3)) +
                kSeventh * (e.c3 * e.c3 + 2.0 * e.c2 * e.c4) + kNinth * e.c4 * e.c4);
}

// Adds the integrals from begin to end, a part of one hold.
void add(double begin, double end, const Hold& hold, const Target& target,
         Integrals& integrals) noexcept {
  double half = 0.5 * (end - begin);
  int64_t pieces = 1;
  if (half * target.omega > kHalfPiece) {
    const double wanted = half * target.omega / kHalfPiece;
    pieces = static_cast<int64_t>(wanted);
    if (static_cast<double>(pieces) < wanted) ++pieces;
    half /= static_cast<double>(pieces);
  }
  const double q = target.omega * half;
  for (int64_t i = 0; i < pieces; ++i) {
    const double middle = begin + static_cast<double>(2 * i + 1) * half;
    const double held = middle - hold.since;
    const SineCosine swing = sine_cosine(target.omega * middle);
    const double sine = target.amplitude * swing.sine;
    const double cosine = q * target.amplitude * swing.cosine;
    const Polynomial e = {
        .c0 = sine - hold.position_after(held),
        .c1 = cosine - half * hold.velocity_after(held),
        .c2 = -0.5 * (q * q * sine + hold.acceleration * half * half),
        .c3 = -q * q * cosine / 6.0,
        .c4 = q * q * q * q * sine / 24.0,
    };
    integrals.squared += half * integral_of_square(e);
    integrals.absolute += half * integral_of_absolute(e);
  }
}

}  // namespace
}  // namespace dwell

DWELL_EXPORT int64_t dwell_follow(const double* measured_s, const double* actuated_s, int64_t n,
                                  double begin_s, double end_s, int64_t is_double, double gain,
                                  double damping, double amplitude, double omega,
                                  dwell::Hold* holds, dwell::Integrals* integrals) noexcept {
  using namespace dwell;
  const Target target = {amplitude, omega};
  *integrals = {0.0, 0.0};
  holds[0] = {0.0, 0.0, 0.0, 0.0};
  int64_t seen = 0;
  for (int64_t k = 0;; ++k) {
    Hold hold = holds[k];
    const double until = k < n ? actuated_s[k] : end_s;
    const double begin = std::max(hold.since, begin_s), end = std::min(until, end_s);
    if (begin < end) add(begin, end, hold, target, *integrals);
    if (k == n || until >= end_s) return kDone;

    const double held = until - hold.since;
    hold.since = until;
    hold.position = holds[k].position_after(held);
    hold.velocity = holds[k].velocity_after(held);
    if (!(std::fabs(hold.position) < kFar * amplitude)) return kDiverged;

    // The camera's measurement; its instant may be several holds earlier.
    const double at = measured_s[k];
    while (seen < k && actuated_s[seen] <= at) ++seen;
    while (seen > 0 && actuated_s[seen - 1] > at) --seen;
    const double before = at - holds[seen].since;
    const SineCosine swing = sine_cosine(omega * at);
    const double error = amplitude * swing.sine - holds[seen].position_after(before);
    if (is_double) {
      const double slope = amplitude * omega * swing.cosine - holds[seen].velocity_after(before);
      hold.acceleration = gain * error + damping * slope;
    } else {
      hold.velocity = gain * error;
    }
    holds[k + 1] = hold;
  }
}
