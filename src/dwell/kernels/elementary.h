#pragma once

// Elementary functions with the same bits from every compiler and on every processor; the functions
// of the C library differ between processors. All operations round to nearest.

#include <bit>
#include <cstdint>

#include "powers_of_two.h"

namespace dwell {

// e^x to within 0.52 ulp, for |x| <= 700.
inline double exp(double x) noexcept {
  // n: the nearest multiple of log(2)/128, in the last bits of the sum. The rest is below 0.0028.
  // log(2)/128 is split into two parts to make the first product exact.
  constexpr double kRound = 0x1.8p52;
  const double shifted = x * 0x1.71547652b82fep+7 + kRound;
  const double n = shifted - kRound;
  const double rest = (x - n * 0x1.62e42fefa0000p-8) - n * 0x1.cf79abc9e3b3ap-47;

  // Taylor series of e^rest - 1: the first omitted term is below 2^-59.
  const double square = rest * rest;
  const double terms =
      rest + square * ((1.0 / 2 + rest * (1.0 / 6)) + square * (1.0 / 24 + rest * (1.0 / 120)));

  // 2^(n/128): n % 128 selects the table entry, and n / 128 is added to its exponent.
  const uint64_t bits = std::bit_cast<uint64_t>(shifted);
  const uint64_t fraction = bits % 128;
  const double power =
      std::bit_cast<double>(std::bit_cast<uint64_t>(kPower[fraction]) + ((bits - fraction) << 45));
  return power + power * (terms + kPowerLost[fraction]);
}

// Natural logarithm to within 1 ulp, for finite x from 2^-1022 on.
inline double log(double x) noexcept {
  // x = 2^n (1 + f), where 1 + f is between sqrt(1/2) and sqrt(2).
  constexpr uint64_t kSqrtHalf = std::bit_cast<uint64_t>(0x1.6a09e667f3bcdp-1);
  const uint64_t bits = std::bit_cast<uint64_t>(x);
  const int64_t exponent = static_cast<int64_t>(bits - kSqrtHalf) >> 52;
  const double n = static_cast<double>(exponent);
  const double f = std::bit_cast<double>(bits - (static_cast<uint64_t>(exponent) << 52)) - 1.0;

  // With s = f / (2 + f): log(1 + f) = 2 (s + s^3/3 + s^5/5 + ...) = f - s (f - 2 (s^2/3 + ...));
  // the first omitted term is below 2^-66.
  const double s = f / (2.0 + f);
  const double z = s * s;
  double terms = 2.0 / 23;
  terms = terms * z + 2.0 / 21;
  terms = terms * z + 2.0 / 19;
  terms = terms * z + 2.0 / 17;
  terms = terms * z + 2.0 / 15;
  terms = terms * z + 2.0 / 13;
  terms = terms * z + 2.0 / 11;
  terms = terms * z + 2.0 / 9;
  terms = terms * z + 2.0 / 7;
  terms = terms * z + 2.0 / 5;
  terms = terms * z + 2.0 / 3;
  const double half = 0.5 * f * f;

  // log(2) is split into two parts to make the product of n and the first part exact.
  return n * 0x1.62e42fefa0000p-1 -
         ((half - (s * (half + z * terms) + n * 0x1.cf79abc9e3b3ap-40)) - f);
}

// Cube root to within 0.67 ulp, for 0 and for x from 2^-1022 to 2^1021.
inline double cube_root(double x) noexcept {
  if (x == 0.0) return x;
  // A third of the exponent: an error of 4 % at most. Each step of Halley's method cubes the error.
  constexpr uint64_t kTwoThirds = 0x2a9f789300000000;
  double root = std::bit_cast<double>(std::bit_cast<uint64_t>(x) / 3 + kTwoThirds);
  for (int step = 0; step < 2; ++step) {
    const double cube = root * root * root;
    root *= (cube + 2.0 * x) / (2.0 * cube + x);
  }

  // Round to 23 bits before the last step to make the square exact.
  constexpr uint64_t kHalf = uint64_t{1} << 29;
  root = std::bit_cast<double>((std::bit_cast<uint64_t>(root) + kHalf) & ~(2 * kHalf - 1));
  const double quotient = x / (root * root);
  return root + root * ((quotient - root) / (2.0 * root + quotient));
}

struct SineCosine {
  double sine;
  double cosine;
};

// Sine and cosine of an angle, rad, to within 1 ulp for |angle| < 10^8.
inline SineCosine sine_cosine(double angle) noexcept {
  // n: the nearest multiple of pi/2, in the last bits of the sum.
  constexpr double kRound = 0x1.8p52;
  const double shifted = angle * 0x1.45f306dc9c883p-1 + kRound;
  const uint64_t quadrant = std::bit_cast<uint64_t>(shifted) & 3;
  const double n = shifted - kRound;

  // The rest of the angle (Cody and Waite). pi/2 is split into parts of 26 bits to make the
  // products and the first two differences exact; x + tail then has twice the digits of a double.
  const double rest = (angle - n * 0x1.921fb50000000p+0) - n * 0x1.110b460000000p-26;
  const double third = n * 0x1.1a62630000000p-54;
  const double left = rest - third;
  const double back = rest - left;
  const double lost = (rest - (left + back)) - (third - back);
  const double small = lost - n * 0x1.8a2e03707344ap-81;
  const double x = left + small;
  const double tail = (left - x) + small;

  // Taylor series: the first omitted term is below 2^-57 of the sum.
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
