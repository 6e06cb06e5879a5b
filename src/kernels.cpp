// xalign_ros.core.kernels: the inner loops of a step. Shapes and meanings: xalign_ros/core/kernels.pyi.

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <stdexcept>
#include <string>

#include "camera.hpp"
#include "matching.hpp"
#include "pose.hpp"

namespace py = pybind11;
using xalign::Camera;
using xalign::Match;
using xalign::Pose;

namespace {

template <class T>
using Rows = py::array_t<T, py::array::c_style | py::array::forcecast>;  // small: copied where they lie otherwise
template <class T>
using Table = py::array_t<T, py::array::c_style>;  // may be a map's, of millions of rows: never copied

template <class A>
void expect(const A &array, const char *name, std::initializer_list<py::ssize_t> shape) {
  bool fits = array.ndim() == static_cast<py::ssize_t>(shape.size());
  for (std::size_t n = 0; fits && n < shape.size(); ++n)
    fits = shape.begin()[n] < 0 || shape.begin()[n] == array.shape(n);
  if (!fits) throw std::invalid_argument(std::string(name) + " has another shape than xalign_ros/core/kernels.pyi says");
}

void expect_rows(const Rows<std::int64_t> &rows, py::ssize_t end) {
  for (py::ssize_t n = 0; n < rows.size(); ++n)
    if (rows.data()[n] < 0 || rows.data()[n] >= end) throw std::out_of_range("a row is not in its table");
}

const Camera &camera_of(const Rows<double> &numbers) {
  expect(numbers, "numbers", {sizeof(Camera) / sizeof(double)});
  return *reinterpret_cast<const Camera *>(numbers.data());
}

Pose pose_of(const Rows<double> &R, const Rows<double> &t) {
  expect(R, "R", {3, 3}), expect(t, "t", {3});
  Pose T;
  std::copy(R.data(), R.data() + 9, T.R);
  std::copy(t.data(), t.data() + 3, T.t);
  return T;
}

template <class T>
py::array_t<T> array_of(const std::vector<T> &values) {
  return py::array_t<T>(values.size(), values.data());
}

py::array_t<double> matrix_of(py::ssize_t rows, py::ssize_t columns, const double *values) {
  return py::array_t<double>({rows, columns}, values);
}

py::tuple arrays_of(const xalign::Pairs &pairs) {
  return py::make_tuple(array_of(pairs.feature), array_of(pairs.point), array_of(pairs.distance));
}

// Columns are contiguous: NumPy is fast on them.
py::tuple project(const Rows<double> &numbers, const py::array_t<double, py::array::forcecast> &xyz) {
  const Camera &camera = camera_of(numbers);
  expect(xyz, "xyz", {-1, 3});
  const py::ssize_t count = xyz.shape(0);
  py::array_t<double, py::array::f_style> uv({count, py::ssize_t(2)}), J({count, py::ssize_t(2), py::ssize_t(3)});
  py::array_t<bool> valid(count);
  const auto x = xyz.unchecked<2>();
  double *pixel = uv.mutable_data(), *slope = J.mutable_data(), one[2], by[6];
  bool *good = valid.mutable_data();
  for (py::ssize_t n = 0; n < count; ++n) {
    good[n] = camera.project(x(n, 0), x(n, 1), x(n, 2), one, by);
    for (int i = 0; i < 2; ++i) {
      pixel[n + i * count] = one[i];
      for (int j = 0; j < 3; ++j) slope[n + (i + 2 * j) * count] = by[3 * i + j];
    }
  }
  return py::make_tuple(uv, valid, J);
}

py::tuple distort(const Rows<double> &numbers, const py::array_t<double, py::array::forcecast> &points) {
  expect(numbers, "numbers", {sizeof(xalign::Plane) / sizeof(double)}), expect(points, "points", {-1, 2});
  const auto &plane = *reinterpret_cast<const xalign::Plane *>(numbers.data());
  const py::ssize_t count = points.shape(0);
  py::array_t<double, py::array::f_style> f({count, py::ssize_t(2)}), J({count, py::ssize_t(2), py::ssize_t(2)});
  const auto a = points.unchecked<2>();
  double one[2], by[4];
  for (py::ssize_t n = 0; n < count; ++n) {
    plane.distort(a(n, 0), a(n, 1), one, by);
    for (int i = 0; i < 2; ++i) {
      f.mutable_data()[n + i * count] = one[i];
      for (int j = 0; j < 2; ++j) J.mutable_data()[n + (i + 2 * j) * count] = by[2 * i + j];
    }
  }
  return py::make_tuple(f, J);
}

py::array_t<double> undistort(const Rows<double> &numbers, const Rows<double> &points, const Rows<double> &start,
                              double limit, bool small) {
  expect(numbers, "numbers", {sizeof(xalign::Plane) / sizeof(double)}), expect(points, "points", {-1, 2});
  expect(start, "start", {points.shape(0), 2});
  const auto &plane = *reinterpret_cast<const xalign::Plane *>(numbers.data());
  py::array_t<double> found = matrix_of(points.shape(0), 2, start.data());
  for (py::ssize_t n = 0; n < points.shape(0); ++n)
    plane.newton(points.data() + 2 * n, found.mutable_data() + 2 * n, limit, small);
  return found;
}

py::array_t<double> radius(int lens, const Rows<double> &D, const Rows<double> &r, const Rows<double> &z) {
  expect(D, "D", {6}), expect(r, "r", {-1}), expect(z, "z", {r.shape(0)});
  py::array_t<double> q({py::ssize_t(3), r.shape(0)});
  for (py::ssize_t n = 0; n < r.shape(0); ++n) {
    double one[3];
    xalign::radius(static_cast<xalign::Lens>(lens), D.data(), r.data()[n], z.data()[n], one);
    for (int i = 0; i < 3; ++i) q.mutable_at(i, n) = one[i];
  }
  return q;
}

py::array_t<std::int64_t> points_of(const Table<std::int32_t> &seen, const Rows<std::int64_t> &first,
                                    const Rows<std::int64_t> &last, std::size_t points) {
  expect(first, "first", {-1}), expect(last, "last", {first.shape(0)});
  for (py::ssize_t k = 0; k < first.size(); ++k)
    if (first.data()[k] < 0 || last.data()[k] > seen.size()) throw std::out_of_range("a range is not in its table");
  return array_of(xalign::points_of(seen.data(), first.data(), last.data(), first.size(), points));
}

py::array_t<std::int64_t> visible(const Rows<std::int64_t> &rows, const Table<double> &points, const Table<float> &view,
                                  const Table<float> &distances, const Rows<double> &eye, double least_cosine,
                                  double most_zoom) {
  expect(points, "points", {-1, 3}), expect(view, "view", {points.shape(0), 3});
  expect(distances, "distances", {points.shape(0), 2}), expect(eye, "eye", {3});
  expect_rows(rows, points.shape(0));
  std::vector<std::int64_t> found;
  for (py::ssize_t n = 0; n < rows.size(); ++n) {
    const std::int64_t row = rows.data()[n];
    const double *X = points.data() + 3 * row, *e = eye.data();
    const float *v = view.data() + 3 * row, *d = distances.data() + 2 * row;
    const double x = e[0] - X[0], y = e[1] - X[1], z = e[2] - X[2], distance = std::sqrt(x * x + y * y + z * z);
    if (x * v[0] + y * v[1] + z * v[2] > least_cosine * distance && most_zoom * distance > d[0] &&
        distance < most_zoom * d[1])
      found.push_back(row);
  }
  return array_of(found);
}

py::tuple expected(const Rows<double> &numbers, const Rows<double> &R, const Rows<double> &t, const Rows<double> &cov_cam,
                   const Table<double> &points, const Rows<std::int64_t> &rows, const Rows<double> &box, double least) {
  const Camera &camera = camera_of(numbers);
  const Pose T = pose_of(R, t);
  expect(cov_cam, "cov_cam", {6, 6}), expect(points, "points", {-1, 3}), expect(box, "box", {4});
  expect_rows(rows, points.shape(0));
  std::vector<std::int64_t> seen;
  std::vector<double> centre, S;
  seen.reserve(rows.size()), centre.reserve(2 * rows.size()), S.reserve(3 * rows.size());
  const double *C = cov_cam.data(), *b = box.data();
  for (py::ssize_t n = 0; n < rows.size(); ++n) {
    double x[3], uv[2], J[6], A[12], by[6];
    T.to_camera(points.data() + 3 * rows.data()[n], x);
    if (!camera.project(x[0], x[1], x[2], uv, J)) continue;
    if (!(uv[0] >= b[0] && uv[1] >= b[1] && uv[0] <= b[2] && uv[1] <= b[3])) continue;
    xalign::by_pose(J, x, A);
    double uu = least, cross = 0, vv = least;
    for (int i = 0; i < 6; ++i) {
      by[i] = 0;
      double of_v = 0;
      for (int j = 0; j < 6; ++j) by[i] += C[6 * i + j] * A[j], of_v += C[6 * i + j] * A[6 + j];
      uu += A[i] * by[i], cross += A[i] * of_v, vv += A[6 + i] * of_v;
    }
    seen.push_back(rows.data()[n]);
    centre.insert(centre.end(), uv, uv + 2);
    S.insert(S.end(), {uu, cross, vv});
  }
  const auto count = static_cast<py::ssize_t>(seen.size());
  return py::make_tuple(array_of(seen), matrix_of(count, 2, centre.data()), matrix_of(count, 3, S.data()));
}

// Distances of descriptor `a` to the rows of a table, by the norm's number.
template <class T>
void distances(int norm, const T *a, const T *table, std::ptrdiff_t width, const std::vector<std::int64_t> &rows,
               double *out) {
  if constexpr (std::is_same_v<T, std::uint8_t>) {
    (norm == 0 ? xalign::hamming : static_cast<void (*)(const T *, const T *, std::ptrdiff_t, const std::int64_t *,
                                                        std::size_t, double *)>(xalign::l2))(a, table, width, rows.data(),
                                                                                             rows.size(), out);
  } else if (norm == 3) {
    xalign::cosine(a, table, width, rows.data(), rows.size(), out);
  } else {
    xalign::l2(a, table, width, rows.data(), rows.size(), out);
  }
}

template <class T>
py::tuple candidates(int norm, const Rows<double> &uv, const Table<T> &descriptors, const Rows<double> &centre,
                     const Rows<double> &S, const Rows<std::int64_t> &rows, const Table<T> &table, double sigmas,
                     double most_px, double gate) {
  const py::ssize_t width = descriptors.shape(1);
  expect(uv, "uv", {descriptors.shape(0), 2}), expect(table, "table", {-1, width});
  expect(centre, "centre", {rows.size(), 2}), expect(S, "S", {rows.size(), 3});
  expect_rows(rows, table.shape(0));
  xalign::Pairs found;
  if (uv.shape(0) == 0) return arrays_of(found);
  constexpr double CELL = 16.0;  // px
  const xalign::Grid grid(uv.data(), uv.shape(0), CELL);
  std::vector<std::int64_t> inside;
  std::vector<double> distance;
  for (py::ssize_t n = 0; n < rows.size(); ++n) {
    double a = S.data()[3 * n], b = S.data()[3 * n + 1], c = S.data()[3 * n + 2];
    const double apart = (a - c) / 2, largest = (a + c) / 2 + std::sqrt(apart * apart + b * b);
    const double factor = std::min(sigmas * sigmas, most_px * most_px / largest);
    a *= factor, b *= factor, c *= factor;
    const double scale = 1 / (a * c - b * b), w[3] = {c * scale, -2 * b * scale, a * scale}, half[2] = {std::sqrt(a), std::sqrt(c)};
    inside.clear();
    grid.inside(centre.data() + 2 * n, half, w, inside);
    distance.resize(inside.size());
    distances(norm, table.data() + width * rows.data()[n], descriptors.data(), width, inside, distance.data());
    for (std::size_t k = 0; k < inside.size(); ++k)
      if (distance[k] <= gate) {
        found.feature.push_back(inside[k]);
        found.point.push_back(rows.data()[n]);
        found.distance.push_back(distance[k]);
      }
  }
  return arrays_of(found);
}

py::tuple one_to_one(const Rows<double> &uv, const Rows<std::int64_t> &feature, const Rows<std::int64_t> &point,
                     const Rows<double> &distance, double ratio, double gate, const Table<double> &points,
                     const Rows<double> &eye, double same) {
  expect(uv, "uv", {-1, 2}), expect(points, "points", {-1, 3}), expect(eye, "eye", {3});
  expect(point, "point", {feature.size()}), expect(distance, "distance", {feature.size()});
  expect_rows(feature, uv.shape(0)), expect_rows(point, points.shape(0));
  const auto count = static_cast<std::size_t>(feature.size());
  const xalign::Pairs all{{feature.data(), feature.data() + count},
                          {point.data(), point.data() + count},
                          {distance.data(), distance.data() + count}};
  return arrays_of(
      xalign::one_to_one(uv.data(), uv.shape(0), all, ratio, gate, points.data(), eye.data(), same));
}

std::vector<Match> matches_of(const Rows<double> &uv, const Rows<double> &sigma_px, const Rows<double> &xyz,
                              const Rows<double> &cov) {
  const py::ssize_t count = sigma_px.size();
  expect(uv, "uv", {count, 2}), expect(xyz, "xyz", {count, 3}), expect(cov, "cov", {count, 3, 3});
  std::vector<Match> matches(count);
  for (py::ssize_t n = 0; n < count; ++n) {
    Match &m = matches[n];
    std::copy_n(uv.data() + 2 * n, 2, m.uv);
    std::copy_n(xyz.data() + 3 * n, 3, m.X);
    std::copy_n(cov.data() + 9 * n, 9, m.cov);
    m.sigma_px = sigma_px.data()[n];
  }
  return matches;
}

py::tuple refine_pose(const Rows<double> &numbers, const Rows<double> &R, const Rows<double> &t, const Rows<double> &uv,
                      const Rows<double> &sigma_px, const Rows<double> &xyz, const Rows<double> &cov, double threshold,
                      double flat, std::size_t least, double most_sigma_ratio) {
  Pose T = pose_of(R, t);
  const auto all = matches_of(uv, sigma_px, xyz, cov);
  const auto found = xalign::refine_pose(camera_of(numbers), T, all, threshold, flat, least, most_sigma_ratio);
  return py::make_tuple(found.reason, matrix_of(3, 3, T.R), py::array_t<double>(3, T.t), matrix_of(6, 6, found.H),
                        found.scale, found.depth,
                        py::make_tuple(found.psi2, found.slope, found.slope_variance, found.numbers),
                        array_of(found.size), array_of(found.error_px), array_of(found.sharp));
}

py::array_t<double> pose_influence(const Rows<double> &numbers, const Rows<double> &R, const Rows<double> &t,
                                   const Rows<double> &uv, const Rows<double> &sigma_px, const Rows<double> &xyz,
                                   const Rows<double> &cov) {
  const auto matches = matches_of(uv, sigma_px, xyz, cov);
  py::array_t<double> out({static_cast<py::ssize_t>(matches.size()), py::ssize_t(6), py::ssize_t(3)});
  if (!xalign::pose_influence(camera_of(numbers), pose_of(R, t), matches, out.mutable_data()))
    throw std::invalid_argument("the matches do not fix the pose");
  return out;
}

py::tuple shared_covariance(const Rows<double> &influence, const Rows<double> &xyz, const Rows<double> &cov,
                            const Rows<std::int64_t> &point, const Rows<std::int64_t> &keyframe,
                            const Rows<double> &centre, const Rows<double> &sigma_rad) {
  const py::ssize_t count = xyz.shape(0), observations = point.size();
  expect(influence, "influence", {count, -1, 3}), expect(xyz, "xyz", {count, 3}), expect(cov, "cov", {count, 3, 3});
  expect(keyframe, "keyframe", {observations}), expect(centre, "centre", {observations, 3});
  expect(sigma_rad, "sigma_rad", {observations});
  expect_rows(point, count);
  const py::ssize_t D = influence.shape(1);
  py::array_t<double> rotation({D, D}), position({D, D});
  xalign::shared_covariance(influence.data(), D, xyz.data(), cov.data(), point.data(), keyframe.data(), centre.data(),
                            sigma_rad.data(), observations, rotation.mutable_data(), position.mutable_data());
  return py::make_tuple(rotation, position);
}

}  // namespace

PYBIND11_MODULE(kernels, m) {
  const auto table = [](const char *name) { return py::arg(name).noconvert(); };
  m.def("project", &project, py::arg("numbers"), py::arg("xyz"));
  m.def("distort", &distort, py::arg("numbers"), py::arg("points"));
  m.def("undistort", &undistort, py::arg("numbers"), py::arg("points"), py::arg("start"), py::arg("limit"),
        py::arg("small"));
  m.def("radius", &radius, py::arg("lens"), py::arg("D"), py::arg("r"), py::arg("z"));
  m.def("points_of", &points_of, table("seen"), py::arg("first"), py::arg("last"), py::arg("points"));
  m.def("visible", &visible, py::arg("rows"), table("points"), table("view"), table("distances"), py::arg("eye"),
        py::arg("least_cosine"), py::arg("most_zoom"));
  m.def("expected", &expected, py::arg("numbers"), py::arg("R"), py::arg("t"), py::arg("cov_cam"), table("points"),
        py::arg("rows"), py::arg("box"), py::arg("least"));
  const auto with_candidates = [&](auto *function) {
    m.def("candidates", function, py::arg("norm"), py::arg("uv"), table("descriptors"), py::arg("centre"), py::arg("S"),
          py::arg("rows"), table("table"), py::arg("sigmas"), py::arg("most_px"), py::arg("gate"));
  };
  with_candidates(&candidates<std::uint8_t>);
  with_candidates(&candidates<float>);
  m.def("one_to_one", &one_to_one, py::arg("uv"), py::arg("feature"), py::arg("point"), py::arg("distance"),
        py::arg("ratio"), py::arg("gate"), table("points"), py::arg("eye"), py::arg("same"));
  m.def("refine_pose", &refine_pose, py::arg("numbers"), py::arg("R"), py::arg("t"), py::arg("uv"), py::arg("sigma_px"),
        py::arg("xyz"), py::arg("cov"), py::arg("threshold"), py::arg("flat"), py::arg("least"),
        py::arg("most_sigma_ratio"));
  m.def("pose_influence", &pose_influence, py::arg("numbers"), py::arg("R"), py::arg("t"), py::arg("uv"),
        py::arg("sigma_px"), py::arg("xyz"), py::arg("cov"));
  m.def("shared_covariance", &shared_covariance, py::arg("influence"), py::arg("xyz"), py::arg("cov"), py::arg("point"),
        py::arg("keyframe"), py::arg("centre"), py::arg("sigma_rad"));
}
