// Prints digests of elementary functions and of draws, for test_processors.py.

#include <array>
#include <cstdio>
#include <limits>

#include "elementary.h"
#include "rows.h"
#include "ziggurat.h"

extern "C" void dwell_draw(dwell::DrawnPath* path, int64_t count, double* values) noexcept;

namespace {

constexpr int kCount = 1'000'000;

// FNV-1a of the bits of doubles.
struct Digest {
  const char* name;
  uint64_t hash = 0xcbf29ce484222325;

  void add(double x) {
    hash = (hash ^ std::bit_cast<uint64_t>(x)) * 0x100000001b3;
    hash ^= hash >> 32;
  }
  ~Digest() { std::printf("%s %016llx\n", name, static_cast<unsigned long long>(hash)); }
};

dwell::Sfc64 stream() { return {1, 2, 3, 4}; }

void add_functions() {
  Digest exponentials{"exponentials"}, logarithms{"logarithms"}, roots{"cube_roots"},
      sines{"sines"}, cosines{"cosines"};
  dwell::Sfc64 numbers = stream();
  for (int i = 0; i < kCount; ++i) {
    const double x = 200.0 * numbers.uniform() - 100.0, power = dwell::exp(x);
    const dwell::SineCosine both = dwell::sine_cosine(x * 1e4);
    exponentials.add(power);
    logarithms.add(dwell::log(power));
    roots.add(dwell::cube_root(power));
    sines.add(both.sine);
    cosines.add(both.cosine);
  }
}

void add_draws() {
  static std::array<double, kCount> values;
  const char* names[] = {"constants", "uniforms", "normals", "lognormals", "autoregressions"};
  for (int kind = 0; kind < 5; ++kind) {
    dwell::DrawnPath path{};
    path.stream = stream();
    path.kind = kind < 4 ? kind : 3;
    path.location = 0.3;
    path.spread = 0.7;
    path.least = 0.1;
    path.correlation = kind < 4 ? 0.0 : 0.6;
    path.gain = 0.8;
    path.last = std::numeric_limits<double>::quiet_NaN();
    dwell_draw(&path, kCount, values.data());
    Digest digest{names[kind]};
    for (const double value : values) digest.add(value);
  }
}

}  // namespace

int main() {
  add_functions();
  add_draws();
}
