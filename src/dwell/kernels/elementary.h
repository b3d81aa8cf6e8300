#pragma once

// Elementary functions of our own: the same bits from every compiler and on every processor, where
// those of the C library differ from one processor to the next. All of them round to nearest.

#include <bit>
#include <cstdint>

namespace dwell {

struct SineCosine {
  double sine;
  double cosine;
};

// Sine and cosine of an angle, rad, to within 1 ulp for |angle| < 10^8.
inline SineCosine sine_cosine(double angle) noexcept {
  // The nearest multiple of pi/2, n of them: the sum's last bits are n.
  constexpr double kRound = 0x1.8p52;
  const double shifted = angle * 0x1.45f306dc9c883p-1 + kRound;
  const uint64_t quadrant = std::bit_cast<uint64_t>(shifted) & 3;
  const double n = shifted - kRound;

  // What is left of the angle (Cody and Waite): pi/2 in parts of 26 bits, so that products and the
  // first two differences are exact; then x + tail has twice a double's digits.
  const double rest = (angle - n * 0x1.921fb50000000p+0) - n * 0x1.110b460000000p-26;
  const double third = n * 0x1.1a62630000000p-54;
  const double left = rest - third;
  const double back = rest - left;
  const double lost = (rest - (left + back)) - (third - back);
  const double small = lost - n * 0x1.8a2e03707344ap-81;
  const double x = left + small;
  const double tail = (left - x) + small;

  // Taylor's series: the first term that is left out is below 2^-57 of the sum.
  const double z = x * x;
  double sine_terms = 1.0 / 355687428096000;
  sine_terms = sine_terms * z - 1.0 / 1307674368000;
  sine_terms = sine_terms * z + 1.0 / 6227020800;
  sine_terms = sine_terms * z - 1.0 / 39916800;
  sine_terms = sine_terms * z + 1.0 / 362880;
  sine_terms = sine_terms * z - 1.0 / 5040;
  sine_terms = sine_terms * z + 1.0 / 120;
  sine_terms = sine_terms * z - 1.0 / 6;
  double cosine_terms = 1.0 / 20922789888000;
  cosine_terms = cosine_terms * z - 1.0 / 87178291200;
  cosine_terms = cosine_terms * z + 1.0 / 479001600;
  cosine_terms = cosine_terms * z - 1.0 / 3628800;
  cosine_terms = cosine_terms * z + 1.0 / 40320;
  cosine_terms = cosine_terms * z - 1.0 / 720;
  cosine_terms = cosine_terms * z + 1.0 / 24;

  const double half = 0.5 * z;
  const double head = 1.0 - half;
  const double sine = x + (x * z * sine_terms + tail * head);
  const double cosine = head + (((1.0 - head) - half) + (z * z * cosine_terms - x * tail));
  switch (quadrant) {
    case 0:
      return {sine, cosine};
    case 1:
      return {cosine, -sine};
    case 2:
      return {-sine, -cosine};
    default:
      return {-cosine, sine};
  }
}

}  // namespace dwell
