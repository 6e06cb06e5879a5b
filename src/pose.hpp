// The refinement of a pose by its matches, and what the map's errors do to it.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "camera.hpp"

namespace xalign {

// x of H x = g, H (D, D) symmetric and positive definite; false where it is not. Cholesky in place of H, x in place of g
// (D, columns) by rows.
template <int D>
bool solve(double *H, double *g, int columns) {
  for (int i = 0; i < D; ++i)
    for (int j = 0; j <= i; ++j) {
      double sum = H[i * D + j];
      for (int k = 0; k < j; ++k) sum -= H[i * D + k] * H[j * D + k];
      if (i != j) {
        H[i * D + j] = sum / H[j * D + j];
      } else if (sum > 0) {
        H[i * D + i] = std::sqrt(sum);
      } else {
        return false;
      }
    }
  for (int c = 0; c < columns; ++c) {
    for (int i = 0; i < D; ++i) {
      for (int k = 0; k < i; ++k) g[i * columns + c] -= H[i * D + k] * g[k * columns + c];
      g[i * columns + c] /= H[i * D + i];
    }
    for (int i = D - 1; i >= 0; --i) {
      for (int k = i + 1; k < D; ++k) g[i * columns + c] -= H[k * D + i] * g[k * columns + c];
      g[i * columns + c] /= H[i * D + i];
    }
  }
  return true;
}

// Of numbers that are not sorted; they are put in another order.
inline double upper_median(std::vector<double> &x) {
  std::nth_element(x.begin(), x.begin() + x.size() / 2, x.end());
  return x[x.size() / 2];
}

// R exp(hat(w)) in place of R (3, 3).
inline void turn(double R[9], const double w[3]) {
  const double half = std::sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]) / 2;
  const double k = half > 0 ? std::sin(half) / half / 2 : 0.5;
  const double x = k * w[0], y = k * w[1], z = k * w[2], c = std::cos(half);
  const double E[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - z * c),     2 * (x * z + y * c),
                       2 * (x * y + z * c),     1 - 2 * (x * x + z * z), 2 * (y * z - x * c),
                       2 * (x * z - y * c),     2 * (y * z + x * c),     1 - 2 * (x * x + y * y)};
  for (int i = 0; i < 3; ++i) {
    const double row[3] = {R[3 * i], R[3 * i + 1], R[3 * i + 2]};
    for (int j = 0; j < 3; ++j) R[3 * i + j] = row[0] * E[j] + row[1] * E[3 + j] + row[2] * E[6 + j];
  }
}

inline double length(const double r[2]) { return std::sqrt(r[0] * r[0] + r[1] * r[1]); }  // hypot takes ten times as long

struct Match {
  double uv[2], sigma_px, X[3], cov[9];
};

struct Residual {
  double r[2], A[12];        // in sigmas, and its rows (2, 6) of the Jacobian by the camera's own turn and shift
  double size, error_px;     // its length in sigmas, infinite where the point has no pixel; in px
  double depth, W[3];        // L^-1 of its covariance L L^T: by rows, below the diagonal
};

// `whiten`: take W anew.
inline void residual(const Camera &camera, const Pose &T, const Match &m, bool whiten, Residual &out) {
  double x[3], uv[2], J[6];
  T.to_camera(m.X, x);
  const bool valid = camera.project(x[0], x[1], x[2], uv, J);
  for (int i = 0; i < 2; ++i) out.r[i] = valid ? uv[i] - m.uv[i] : 0.0;
  if (!valid) std::fill(J, J + 6, 0.0);
  out.depth = x[2], out.error_px = length(out.r);
  if (whiten) {
    double M[6], uu = m.sigma_px * m.sigma_px, uv_ = 0, vv = uu;
    by_point(J, T.R, M);
    for (int i = 0; i < 3; ++i) {
      double by_u = 0, by_v = 0;
      for (int j = 0; j < 3; ++j) by_u += m.cov[3 * i + j] * M[j], by_v += m.cov[3 * i + j] * M[3 + j];
      uu += by_u * M[i], uv_ += by_u * M[3 + i], vv += by_v * M[3 + i];
    }
    const double a = std::sqrt(uu), b = uv_ / a, c = std::sqrt(std::max(vv - b * b, 1e-12));
    out.W[0] = 1 / a, out.W[1] = -b / (a * c), out.W[2] = 1 / c;
  }
  const auto whitened = [&](double &u, double &v) {
    v = out.W[1] * u + out.W[2] * v;
    u = out.W[0] * u;
  };
  whitened(out.r[0], out.r[1]);
  for (int j = 0; j < 3; ++j) whitened(J[j], J[3 + j]);
  by_pose(J, x, out.A);
  out.size = valid ? length(out.r) : std::numeric_limits<double>::infinity();
}

struct Refinement {
  const char *reason = "";  // why there is none
  double H[36] = {};        // of all that had a weight, each as one
  double scale = 0, depth = 0;  // of the residuals over what they should be; median, m
  double psi2 = 0, slope = 0, slope_variance = 0, numbers = 0;
  std::vector<double> size, error_px, sharp;  // (N,) in sigmas before the scale, infinite for those left out; in px; part
};

// core/pnp.py's refine_pose, but for what it makes of the result; T is moved.
inline Refinement refine_pose(const Camera &camera, Pose &T, const std::vector<Match> &all, double threshold,
                              double flat, std::size_t least, double most_sigma_ratio) {
  constexpr int SWEEPS = 10;            // at most
  constexpr double FAR = 5.0;           // times the threshold; no sweep brings such a match back
  constexpr double WIDE = 3.0;          // scale of the first sweep: from below, scale and inliers may hold each other down
  constexpr double LEAST_SCALE = 0.3;   // of the residuals over what the features say of themselves
  constexpr double CONVERGED = 0.2;     // length of a step in sigmas of the pose: the next would be an eighth of it
  constexpr double RAYLEIGH = 1.1774;   // median length of two Gaussian components of sigma 1
  Refinement out;
  std::vector<Match> matches;
  std::vector<Residual> residuals;
  std::vector<std::size_t> row;
  for (std::size_t n = 0; n < all.size(); ++n) {
    Residual r;
    residual(camera, T, all[n], true, r);
    if (r.size < FAR * threshold) matches.push_back(all[n]), residuals.push_back(r), row.push_back(n);
  }
  std::vector<std::size_t> used;
  std::vector<double> some, part;
  out.scale = WIDE;
  for (int sweep = 0; sweep < SWEEPS; ++sweep) {
    used.clear(), some.clear(), part.clear();
    for (std::size_t n = 0; n < residuals.size(); ++n)
      if (residuals[n].size < flat * out.scale) used.push_back(n), some.push_back(residuals[n].size);
    if (used.size() < least || used.empty()) return out.reason = "too_few_inliers", out;
    out.scale = std::max(upper_median(some) / RAYLEIGH, LEAST_SCALE);
    double H[36] = {}, g[6] = {}, trace = 0, step[6];
    some.clear();
    for (const std::size_t n : used) {
      const Residual &r = residuals[n];
      const double u = r.size / out.scale, rest = std::max(1 - u * u / (flat * flat), 0.0), weight = rest * rest;
      part.push_back(rest), some.push_back(r.depth);
      for (int i = 0; i < 6; ++i) {
        const double a = weight * r.A[i], b = weight * r.A[6 + i];
        for (int j = 0; j <= i; ++j) H[6 * i + j] += a * r.A[j] + b * r.A[6 + j];
        g[i] += a * r.r[0] + b * r.r[1];
      }
    }
    for (int i = 0; i < 6; ++i) trace += H[7 * i], step[i] = -g[i];
    for (int i = 0; i < 6; ++i) H[7 * i] += 1e-9 * trace;
    out.depth = upper_median(some);
    const double most = most_sigma_ratio * out.depth;
    if (!solve<6>(H, step, 1) || step[3] * step[3] + step[4] * step[4] + step[5] * step[5] > most * most)
      return out.reason = "degenerate", out;
    for (int i = 0; i < 3; ++i) T.t[i] += T.R[3 * i] * step[3] + T.R[3 * i + 1] * step[4] + T.R[3 * i + 2] * step[5];
    turn(T.R, step);
    double gain = 0;
    for (int i = 0; i < 6; ++i) gain -= step[i] * g[i];
    if (sweep && gain < CONVERGED * CONVERGED * out.scale * out.scale) {
      for (Residual &r : residuals) {  // so small a step is linear
        for (int i = 0; i < 6; ++i) r.r[0] += step[i] * r.A[i], r.r[1] += step[i] * r.A[6 + i];
        r.size = length(r.r);
      }
      break;
    }
    for (std::size_t n = 0; n < residuals.size(); ++n) residual(camera, T, matches[n], false, residuals[n]);
  }
  std::vector<double> slopes;
  for (std::size_t k = 0; k < used.size(); ++k) {
    // The weights are those of the last sweep, whose sizes a step since then has changed.
    const double rest = part[k], weight = rest * rest, u2 = (1 - rest) * flat * flat;
    out.psi2 += weight * weight * u2 / 2, out.numbers += 2 * weight;
    slopes.push_back(weight - 2 * rest * (1 - rest));
    out.slope += slopes.back();
    const double *A = residuals[used[k]].A;
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) out.H[6 * i + j] += A[i] * A[j] + A[6 + i] * A[6 + j];
  }
  out.psi2 /= used.size(), out.slope /= used.size();
  for (const double s : slopes) out.slope_variance += (s - out.slope) * (s - out.slope) / used.size();
  out.size.assign(all.size(), std::numeric_limits<double>::infinity());
  out.error_px.assign(all.size(), 0.0), out.sharp.assign(all.size(), 0.0);
  for (std::size_t n = 0; n < residuals.size(); ++n) {
    const Residual &r = residuals[n];
    out.size[row[n]] = r.size, out.error_px[row[n]] = r.error_px;
    out.sharp[row[n]] = matches[n].sigma_px * matches[n].sigma_px * r.W[0] * r.W[2];
  }
  return out;
}

// By how much (N, 6, 3) the least squares pose of the matches moves, its tangent on the right, with each point; false
// where the matches do not fix the pose.
inline bool pose_influence(const Camera &camera, const Pose &T, const std::vector<Match> &matches, double *out) {
  double H[36] = {};
  std::vector<double> A(12 * matches.size()), M(6 * matches.size()), weights;
  for (std::size_t n = 0; n < matches.size(); ++n) {
    const Match &m = matches[n];
    double x[3], uv[2], J[6], *a = &A[12 * n], *by = &M[6 * n], spread = 0;
    T.to_camera(m.X, x);
    if (!camera.project(x[0], x[1], x[2], uv, J)) std::fill(J, J + 6, 0.0);
    by_point(J, T.R, by);
    by_pose(J, x, a);
    for (int i = 0; i < 2; ++i)
      for (int j = 0; j < 3; ++j)
        for (int k = 0; k < 3; ++k) spread += by[3 * i + j] * m.cov[3 * j + k] * by[3 * i + k];
    weights.push_back(1 / (m.sigma_px * m.sigma_px + spread / 2));
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) H[6 * i + j] += weights[n] * (a[i] * a[j] + a[6 + i] * a[6 + j]);
  }
  for (std::size_t n = 0; n < matches.size(); ++n) {
    const double *a = &A[12 * n], *by = &M[6 * n];
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 3; ++j) out[18 * n + 3 * i + j] = -weights[n] * (a[i] * by[j] + a[6 + i] * by[3 + j]);
  }
  double L[36];
  for (std::size_t n = 0; n < matches.size(); ++n) {
    std::copy(H, H + 36, L);
    if (!solve<6>(L, out + 18 * n, 3)) return false;
  }
  return true;
}

// core/map_error.py's shared_covariance: rotation and position (D, D) each. influence (P, D, 3), cov (P, 3, 3).
inline void shared_covariance(const double *influence, std::size_t D, const double *xyz, const double *cov,
                              const std::int64_t *point, const std::int64_t *keyframe, const double *centre,
                              const double *sigma_rad, std::size_t observations, double *rotation, double *position) {
  std::vector<std::int64_t> own(keyframe, keyframe + observations);
  std::sort(own.begin(), own.end());
  own.erase(std::unique(own.begin(), own.end()), own.end());
  std::vector<double> G(own.size() * D * 6);  // of each keyframe: by its turn, its shift
  for (std::size_t o = 0; o < observations; ++o) {
    const std::size_t k = std::lower_bound(own.begin(), own.end(), keyframe[o]) - own.begin();
    const double *p = xyz + 3 * point[o], *c = centre + 3 * o, *C = cov + 9 * point[o];
    const double x[3] = {p[0] - c[0], p[1] - c[1], p[2] - c[2]};
    const double range2 = x[0] * x[0] + x[1] * x[1] + x[2] * x[2], weight = 1 / (range2 * sigma_rad[o] * sigma_rad[o]);
    // What moves the point's normal equations: hat(x), which takes out what is along x, and I - u u^T.
    const double N[3][6] = {{0, -x[2], x[1], 1 - x[0] * x[0] / range2, -x[0] * x[1] / range2, -x[0] * x[2] / range2},
                            {x[2], 0, -x[0], -x[1] * x[0] / range2, 1 - x[1] * x[1] / range2, -x[1] * x[2] / range2},
                            {-x[1], x[0], 0, -x[2] * x[0] / range2, -x[2] * x[1] / range2, 1 - x[2] * x[2] / range2}};
    for (std::size_t d = 0; d < D; ++d) {
      const double *i = influence + (point[o] * D + d) * 3;
      double *g = &G[(k * D + d) * 6];
      for (int a = 0; a < 3; ++a) {
        const double moved = weight * (i[0] * C[a] + i[1] * C[3 + a] + i[2] * C[6 + a]);
        for (int b = 0; b < 6; ++b) g[b] += moved * N[a][b];
      }
    }
  }
  std::fill(rotation, rotation + D * D, 0.0), std::fill(position, position + D * D, 0.0);
  for (std::size_t k = 0; k < own.size(); ++k)
    for (std::size_t d = 0; d < D; ++d)
      for (std::size_t e = 0; e < D; ++e) {
        const double *g = &G[(k * D + d) * 6], *h = &G[(k * D + e) * 6];
        rotation[d * D + e] += g[0] * h[0] + g[1] * h[1] + g[2] * h[2];
        position[d * D + e] += g[3] * h[3] + g[4] * h[4] + g[5] * h[5];
      }
}

}  // namespace xalign
