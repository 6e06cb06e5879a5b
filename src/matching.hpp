// 2D-3D matches: which points may be seen, which features lie where they are expected, which pairs are one to one.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "camera.hpp"

namespace xalign {

// The same code for processors with and without these instructions; nothing is contracted, so the numbers do not differ.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define FOR_ANY_X86 __attribute__((target_clones("arch=haswell", "popcnt", "default")))
#else
#define FOR_ANY_X86
#endif

// Distances of one descriptor of `width` numbers to those at `rows` (count) of a table.

FOR_ANY_X86 inline void hamming(const std::uint8_t *a, const std::uint8_t *table, std::ptrdiff_t width,
                                const std::int64_t *rows, std::size_t count, double *out) {
  const std::ptrdiff_t words = width / 8;
  for (std::size_t n = 0; n < count; ++n) {
    const std::uint8_t *b = table + rows[n] * width;
    int bits = 0;
    for (std::ptrdiff_t k = 0; k < words; ++k) {
      std::uint64_t x, y;
      std::memcpy(&x, a + 8 * k, 8);
      std::memcpy(&y, b + 8 * k, 8);
      bits += __builtin_popcountll(x ^ y);
    }
    for (std::ptrdiff_t k = 8 * words; k < width; ++k) bits += __builtin_popcount(a[k] ^ b[k]);
    out[n] = bits;
  }
}

FOR_ANY_X86 inline void l2(const std::uint8_t *a, const std::uint8_t *table, std::ptrdiff_t width,
                           const std::int64_t *rows, std::size_t count, double *out) {
  for (std::size_t n = 0; n < count; ++n) {
    const std::uint8_t *b = table + rows[n] * width;
    int sum = 0;
    for (std::ptrdiff_t k = 0; k < width; ++k) {
      const int d = int(a[k]) - int(b[k]);
      sum += d * d;
    }
    out[n] = std::sqrt(double(sum));
  }
}

constexpr int LANES = 8;  // partial sums, whatever the width of the processor's registers

FOR_ANY_X86 inline void l2(const float *a, const float *table, std::ptrdiff_t width, const std::int64_t *rows,
                           std::size_t count, double *out) {
  for (std::size_t n = 0; n < count; ++n) {
    const float *b = table + rows[n] * width;
    float lanes[LANES] = {};
    std::ptrdiff_t k = 0;
    for (; k + LANES <= width; k += LANES)
      for (int i = 0; i < LANES; ++i) {
        const float d = a[k + i] - b[k + i];
        lanes[i] += d * d;
      }
    for (; k < width; ++k) lanes[0] += (a[k] - b[k]) * (a[k] - b[k]);
    double sum = 0;
    for (const float lane : lanes) sum += lane;
    out[n] = std::sqrt(sum);
  }
}

FOR_ANY_X86 inline void cosine(const float *a, const float *table, std::ptrdiff_t width, const std::int64_t *rows,
                               std::size_t count, double *out) {
  for (std::size_t n = 0; n < count; ++n) {
    const float *b = table + rows[n] * width;
    float ab[LANES] = {}, aa[LANES] = {}, bb[LANES] = {};
    std::ptrdiff_t k = 0;
    for (; k + LANES <= width; k += LANES)
      for (int i = 0; i < LANES; ++i) {
        ab[i] += a[k + i] * b[k + i];
        aa[i] += a[k + i] * a[k + i];
        bb[i] += b[k + i] * b[k + i];
      }
    for (; k < width; ++k) ab[0] += a[k] * b[k], aa[0] += a[k] * a[k], bb[0] += b[k] * b[k];
    double dot = 0, a2 = 0, b2 = 0;
    for (int i = 0; i < LANES; ++i) dot += ab[i], a2 += aa[i], b2 += bb[i];
    out[n] = 1 - dot / std::max(std::sqrt(a2) * std::sqrt(b2), 1e-12);
  }
}

// Points (sorted) that any of these keyframes sees: ranges [first, last) of `seen`. Raises std::out_of_range.
inline std::vector<std::int64_t> points_of(const std::int32_t *seen, const std::int64_t *first, const std::int64_t *last,
                                           std::size_t keyframes, std::size_t points) {
  std::vector<std::uint64_t> bits((points + 63) / 64);
  for (std::size_t k = 0; k < keyframes; ++k)
    for (std::int64_t n = first[k]; n < last[k]; ++n) {
      const auto point = static_cast<std::uint32_t>(seen[n]);
      if (point >= points) throw std::out_of_range("a keyframe of the map sees a point that is not there");
      bits[point / 64] |= std::uint64_t(1) << (point % 64);
    }
  std::vector<std::int64_t> found;
  for (std::size_t word = 0; word < bits.size(); ++word)
    for (std::uint64_t left = bits[word]; left; left &= left - 1) found.push_back(64 * word + __builtin_ctzll(left));
  return found;
}

// Features (N, 2) by the cells of a grid over them.
class Grid {
 public:
  Grid(const double *uv, std::size_t count, double cell) {
    for (int axis = 0; axis < 2; ++axis) {
      low_[axis] = high_[axis] = uv[axis];
      for (std::size_t n = 1; n < count; ++n) {
        low_[axis] = std::min(low_[axis], uv[2 * n + axis]);
        high_[axis] = std::max(high_[axis], uv[2 * n + axis]);
      }
      per_px_[axis] = 1 / std::max(cell, (high_[axis] - low_[axis]) / MOST);
      cells_[axis] = cell_of(high_[axis], axis) + 1;
    }
    start_.assign(cells_[0] * cells_[1] + 1, 0);
    std::vector<int> own(count);
    for (std::size_t n = 0; n < count; ++n) {
      own[n] = cell_of(uv[2 * n + 1], 1) * cells_[0] + cell_of(uv[2 * n], 0);
      ++start_[own[n] + 1];
    }
    for (std::size_t c = 1; c < start_.size(); ++c) start_[c] += start_[c - 1];
    std::vector<int> next(start_.begin(), start_.end() - 1);
    row_.resize(count), uv_.resize(2 * count);
    for (std::size_t n = 0; n < count; ++n) {
      const int at = next[own[n]]++;
      row_[at] = n, uv_[2 * at] = uv[2 * n], uv_[2 * at + 1] = uv[2 * n + 1];
    }
  }

  // Rows of uv within w[0] du^2 + w[1] du dv + w[2] dv^2 <= 1 of a centre; no further off than half (2).
  void inside(const double centre[2], const double half[2], const double w[3], std::vector<std::int64_t> &found) const {
    for (int axis = 0; axis < 2; ++axis)
      if (!(centre[axis] + half[axis] >= low_[axis] && centre[axis] - half[axis] <= high_[axis])) return;
    const int left = cell_of(centre[0] - half[0], 0), right = cell_of(centre[0] + half[0], 0);
    const int bottom = cell_of(centre[1] + half[1], 1);
    for (int row = cell_of(centre[1] - half[1], 1); row <= bottom; ++row) {
      const int end = start_[row * cells_[0] + right + 1];
      for (int n = start_[row * cells_[0] + left]; n < end; ++n) {
        const double du = uv_[2 * n] - centre[0], dv = uv_[2 * n + 1] - centre[1];
        if ((w[0] * du + w[1] * dv) * du + w[2] * dv * dv <= 1) found.push_back(row_[n]);
      }
    }
  }

 private:
  static constexpr int MOST = 128;  // cells along an axis

  int cell_of(double x, int axis) const {
    return static_cast<int>((std::clamp(x, low_[axis], high_[axis]) - low_[axis]) * per_px_[axis]);
  }

  double low_[2], high_[2], per_px_[2];
  int cells_[2];
  std::vector<int> start_;
  std::vector<std::int64_t> row_;
  std::vector<double> uv_;
};

struct Pairs {
  std::vector<std::int64_t> feature, point;
  std::vector<double> distance;
};

// Mutual best pairs whose distance is below `ratio` times that of the feature's best pair with a different point: one that
// is not within `same` of the best point's distance to the eye. uv (N, 2) of all features, xyz (M, 3) of all points.
inline Pairs one_to_one(const double *uv, std::size_t features, const Pairs &all, double ratio, double gate,
                        const double *xyz, const double eye[3], double same) {
  constexpr double NONE = std::numeric_limits<double>::infinity();
  std::vector<std::size_t> best(features, all.feature.size());
  const auto nearer = [&](std::size_t a, std::size_t b) {
    return std::tie(all.distance[a], all.point[a]) < std::tie(all.distance[b], all.point[b]);
  };
  for (std::size_t n = 0; n < all.feature.size(); ++n) {
    std::size_t &b = best[all.feature[n]];
    if (b == all.feature.size() || nearer(n, b)) b = n;
  }
  std::vector<double> runner_up(features, NONE);
  for (std::size_t n = 0; n < all.feature.size(); ++n) {
    const std::int64_t f = all.feature[n];
    if (n == best[f] || all.distance[n] >= runner_up[f]) continue;
    const double *p = xyz + 3 * all.point[n], *q = xyz + 3 * all.point[best[f]];
    double off2 = 0, ray2 = 0;
    for (int i = 0; i < 3; ++i) off2 += (p[i] - q[i]) * (p[i] - q[i]), ray2 += (q[i] - eye[i]) * (q[i] - eye[i]);
    if (off2 > same * same * ray2) runner_up[f] = all.distance[n];
  }
  std::vector<std::size_t> kept;
  for (std::size_t f = 0; f < features; ++f) {
    if (best[f] == all.feature.size()) continue;
    const double d = all.distance[best[f]];
    if (d < ratio * runner_up[f] && d <= gate) kept.push_back(best[f]);  // a tie at distance 0 is a tie
  }
  // One to one from the other side: of the features that chose a point, and of those at one place, the nearest.
  const auto only_first = [&](const auto &key) {
    std::sort(kept.begin(), kept.end(), [&](std::size_t a, std::size_t b) {
      const auto ka = key(a), kb = key(b);
      return ka != kb ? ka < kb
                      : std::tie(all.distance[a], all.feature[a]) < std::tie(all.distance[b], all.feature[b]);
    });
    kept.erase(std::unique(kept.begin(), kept.end(), [&](std::size_t a, std::size_t b) { return key(a) == key(b); }),
               kept.end());
  };
  only_first([&](std::size_t n) { return all.point[n]; });
  only_first([&](std::size_t n) { return std::make_pair(uv[2 * all.feature[n]], uv[2 * all.feature[n] + 1]); });
  std::sort(kept.begin(), kept.end(), [&](std::size_t a, std::size_t b) { return all.feature[a] < all.feature[b]; });
  Pairs result;
  for (const std::size_t n : kept) {
    result.feature.push_back(all.feature[n]);
    result.point.push_back(all.point[n]);
    result.distance.push_back(all.distance[n]);
  }
  return result;
}

}  // namespace xalign
