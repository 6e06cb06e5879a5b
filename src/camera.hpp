// Camera models: projection and its Jacobian. Formulas, names and sources: xalign_ros/core/camera.py.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

namespace xalign {

constexpr double NaN = std::numeric_limits<double>::quiet_NaN();

// Distortion in the plane of normalised points, core/camera_plane.py: its `numbers`, as they lie.
struct Plane {
  double top[4], low[3], p[2], s[4];

  // f (2) of a normalised point, and its Jacobian (2, 2) by rows.
  void distort(double x, double y, double f[2], double J[4]) const {
    const double r2 = x * x + y * y;
    double g = top[3], dg = 0.0;
    for (int n = 2; n >= -1; --n) {
      dg = dg * r2 + g;
      g = g * r2 + (n < 0 ? 1.0 : top[n]);
    }
    if (low[0] != 0 || low[1] != 0 || low[2] != 0) {
      double h = low[2], dh = 0.0;
      for (int n = 1; n >= -1; --n) {
        dh = dh * r2 + h;
        h = h * r2 + (n < 0 ? 1.0 : low[n]);
      }
      dg = (dg * h - g * dh) / (h * h);
      g = g / h;
    }
    f[0] = x * g + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x) + r2 * (s[0] + s[1] * r2);
    f[1] = y * g + p[0] * (r2 + 2 * y * y) + 2 * p[1] * x * y + r2 * (s[2] + s[3] * r2);
    const double xp = 2 * p[1] * x, yp = 2 * p[0] * y, bend = 2 * dg, both = bend * x * y + 2 * p[0] * x + 2 * p[1] * y;
    const double slope_u = 2 * s[0] + 4 * s[1] * r2, slope_v = 2 * s[2] + 4 * s[3] * r2;
    J[0] = g + bend * x * x + yp + 3 * xp + slope_u * x;
    J[1] = both + slope_u * y;
    J[2] = both + slope_v * x;
    J[3] = g + bend * y * y + 3 * yp + xp + slope_v * y;
  }

  // Newton's method from `a` (2) towards what goes to m (2): whole steps, which converge in 3-6 well inside the fold, or
  // small ones first that never leave the disc of radius `limit`.
  void newton(const double m[2], double a[2], double limit, bool small) const {
    constexpr int WHOLE = 20, SMALL = 40, LAST = 10;
    for (int n = 0; n < (small ? SMALL + LAST : WHOLE); ++n) {
      double f[2], J[4];
      distort(a[0], a[1], f, J);
      const double r[2] = {f[0] - m[0], f[1] - m[1]}, part = (small && n < SMALL ? 0.3 : 1.0) / (J[0] * J[3] - J[1] * J[2]);
      a[0] -= part * (J[3] * r[0] - J[1] * r[1]);
      a[1] -= part * (J[0] * r[1] - J[2] * r[0]);
      if (std::abs(r[0]) <= 1e-13 && std::abs(r[1]) <= 1e-13) return;
      const double radius = std::hypot(a[0], a[1]);
      if (small && radius > limit) a[0] *= limit / radius, a[1] *= limit / radius;
    }
  }
};

enum Lens { PINHOLE, EQUIDISTANT, FOV, EUCM, DOUBLE_SPHERE, DIVISION, CUBIC, MIRROR, EQUIRECTANGULAR };

// Distorted radius q of a ray r from the axis and z along it, q and its derivatives by r and z.
inline void radius(Lens lens, const double D[6], double r, double z, double q[3]) {
  switch (lens) {
    case EQUIDISTANT: {
      const double angle = std::atan2(r, z), a2 = angle * angle, n2 = r * r + z * z;
      double poly = D[5], slope = 13 * D[5];
      for (int n = 4; n >= 0; --n) {
        poly = poly * a2 + D[n];
        slope = slope * a2 + (2 * n + 3) * D[n];
      }
      poly = poly * a2 + 1, slope = slope * a2 + 1;
      q[0] = angle * poly, q[1] = slope * z / n2, q[2] = -slope * r / n2;
      return;
    }
    case FOV: {
      const double c = 2 * std::tan(D[0] / 2), g = c / D[0] / (c * c * r * r + z * z);
      q[0] = std::atan2(c * r, z) / D[0], q[1] = g * z, q[2] = -g * r;
      return;
    }
    case EUCM: {
      const double alpha = D[0], beta = D[1], d = std::sqrt(beta * r * r + z * z), w = alpha * d + (1 - alpha) * z;
      q[0] = r / w;
      q[1] = 1 / w - r * (alpha * beta * r / d) / (w * w);
      q[2] = -r * (alpha * z / d + 1 - alpha) / (w * w);
      return;
    }
    case DOUBLE_SPHERE: {
      const double xi = D[0], alpha = D[1], d1 = std::hypot(r, z);
      const double e = xi * d1 + z, e_r = xi * r / d1, e_z = xi * z / d1 + 1, d2 = std::hypot(r, e);
      const double w = alpha * d2 + (1 - alpha) * e;
      q[0] = r / w;
      q[1] = 1 / w - r * (alpha * (r + e * e_r) / d2 + (1 - alpha) * e_r) / (w * w);
      q[2] = -r * (alpha * e * e_z / d2 + (1 - alpha) * e_z) / (w * w);
      return;
    }
    case DIVISION: {
      const double root = std::sqrt(z * z - 4 * D[0] * r * r), w = (z + root) / 2;
      q[0] = r / w;
      q[1] = 1 / w + 2 * D[0] * r * r / (root * (w * w));
      q[2] = -r * (1 + z / root) / (2 * (w * w));
      return;
    }
    case CUBIC: {  // the root of q + k q^3 = u that grows from zero; rays from behind have no pixel
      const double depth = z > 0 ? z : NaN, u = r / depth, c = std::sqrt(3 * std::abs(D[0]));
      q[0] = c == 0   ? u
             : D[0] > 0 ? 2 / c * std::sinh(std::asinh(1.5 * c * u) / 3)
                        : 2 / c * std::sin(std::asin(1.5 * c * u) / 3);
      const double slope = 1 / (1 + 3 * D[0] * q[0] * q[0]);
      q[1] = slope / depth, q[2] = -slope * u / depth;
      return;
    }
    case MIRROR: {
      const double n = std::hypot(r, z), w = z + D[0] * n;
      q[0] = r / w;
      q[1] = 1 / w - D[0] * r * r / (n * (w * w));
      q[2] = -r * (1 + D[0] * z / n) / (w * w);
      return;
    }
    default:
      q[0] = q[1] = q[2] = NaN;
  }
}

// The `numbers` of core/camera.py, as they lie.
struct Camera {
  double lens, D[6];
  Plane plane;
  double tilt[9];  // NaN: the sensor is not tilted
  double limit, K[4];

  // Pixel (2) of a point (3) of the camera's frame and d uv / d x (2, 3) by rows; false, and a pixel of NaN, without one.
  bool project(double x, double y, double z, double uv[2], double J[6]) const {
    double m[2];
    const bool valid = distorted(x, y, z, m, J);
    for (int i = 0; i < 2; ++i) {
      uv[i] = valid ? K[i] * m[i] + K[2 + i] : NaN;
      for (int j = 0; j < 3; ++j) J[3 * i + j] *= K[i];
    }
    return valid;
  }

 private:
  bool distorted(double x, double y, double z, double m[2], double J[6]) const {
    const auto kind = static_cast<Lens>(static_cast<int>(lens));
    if (kind == EQUIRECTANGULAR) return longitude_latitude(x, y, z, m, J);
    double a[2], A[6];
    bool valid;
    if (kind == PINHOLE) {
      const double near = 1 / z;
      a[0] = x * near, a[1] = y * near;
      A[0] = A[4] = near, A[1] = A[3] = 0, A[2] = -a[0] * near, A[5] = -a[1] * near;
      valid = z > 1e-9 && a[0] * a[0] + a[1] * a[1] <= limit * limit;
    } else {
      valid = radial(kind, x, y, z, a, A);
    }
    double P[4];
    plane.distort(a[0], a[1], m, P);
    if (!std::isnan(tilt[0])) {
      double h[3], T[4];
      for (int i = 0; i < 3; ++i) h[i] = tilt[3 * i] * m[0] + tilt[3 * i + 1] * m[1] + tilt[3 * i + 2];
      const double w = h[2] > 0 ? h[2] : NaN;  // its horizon
      m[0] = h[0] / w, m[1] = h[1] / w;
      for (int i = 0; i < 4; ++i) T[i] = (tilt[3 * (i / 2) + i % 2] - m[i / 2] * tilt[6 + i % 2]) / w;
      const double Q[4] = {P[0], P[1], P[2], P[3]};
      for (int i = 0; i < 4; ++i) P[i] = T[i - i % 2] * Q[i % 2] + T[i - i % 2 + 1] * Q[2 + i % 2];
    }
    for (int j = 0; j < 3; ++j) J[j] = P[0] * A[j] + P[1] * A[3 + j], J[3 + j] = P[2] * A[j] + P[3] * A[3 + j];
    return valid;
  }

  // (x, y) q / r with q a function of the angle between ray and axis.
  bool radial(Lens kind, double x, double y, double z, double a[2], double A[6]) const {
    const double r = std::hypot(x, y);
    double q[3];
    radius(kind, D, r, z, q);
    const bool on_axis = r < 1e-9 * std::abs(z);
    const double k = on_axis ? q[1] : q[0] / r, e[2] = {on_axis ? 0.0 : x / r, on_axis ? 0.0 : y / r};
    a[0] = x * k, a[1] = y * k;
    for (int i = 0; i < 2; ++i) {
      for (int j = 0; j < 2; ++j) A[3 * i + j] = (q[1] - k) * e[i] * e[j] + (i == j ? k : 0.0);
      A[3 * i + 2] = q[2] * e[i];
    }
    return std::atan2(r, z) <= limit && r * r + z * z > 1e-18;
  }

  static bool longitude_latitude(double x, double y, double z, double m[2], double J[6]) {
    const double h = std::hypot(x, z), n2 = h * h + y * y;
    m[0] = std::atan2(x, z), m[1] = std::atan2(y, h);
    J[0] = z / (h * h), J[1] = 0, J[2] = -x / (h * h);
    J[3] = -x * y / (h * n2), J[4] = h / n2, J[5] = -z * y / (h * n2);
    return h > 1e-9 * std::abs(y) && h > 1e-9;
  }
};
static_assert(sizeof(Camera) == 34 * sizeof(double), "core/camera.py lays its numbers out so");

// A pose T_map_cam: R (3, 3) by rows, t (3).
struct Pose {
  double R[9], t[3];

  void to_camera(const double X[3], double x[3]) const {
    const double d[3] = {X[0] - t[0], X[1] - t[1], X[2] - t[2]};
    for (int i = 0; i < 3; ++i) x[i] = R[i] * d[0] + R[3 + i] * d[1] + R[6 + i] * d[2];
  }
};

// Rows (2, 6) of J [hat(x), -I]: what the camera's own small turn and shift do to the pixel of its point x.
inline void by_pose(const double J[6], const double x[3], double A[12]) {
  for (int i = 0; i < 2; ++i) {
    const double *j = J + 3 * i;
    double *a = A + 6 * i;
    a[0] = j[1] * x[2] - j[2] * x[1], a[1] = j[2] * x[0] - j[0] * x[2], a[2] = j[0] * x[1] - j[1] * x[0];
    a[3] = -j[0], a[4] = -j[1], a[5] = -j[2];
  }
}

// Derivative (2, 3) of the pixel by the map point: J R^T.
inline void by_point(const double J[6], const double R[9], double M[6]) {
  for (int i = 0; i < 2; ++i)
    for (int j = 0; j < 3; ++j)
      M[3 * i + j] = J[3 * i] * R[3 * j] + J[3 * i + 1] * R[3 * j + 1] + J[3 * i + 2] * R[3 * j + 2];
}

}  // namespace xalign
