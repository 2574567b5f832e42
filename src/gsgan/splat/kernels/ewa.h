// EWA projection of one Gaussian and its hand-derived gradient, in double; the formulas of
// project.py. project.h applies them to all Gaussians.
#pragma once

#include <cmath>
#include <cstdint>

extern "C" {

// Mirrors native_project.py's _Job field by field. Arrays are contiguous; null where not needed.
struct ProjectJob {
  int64_t B, N, H, W;
  int64_t threads;
  int64_t antialias;
  double near, low_pass, alpha_min;
  double reach;          // of the footprint in standard deviations; < 0: by opacity
  double extent_margin;  // by which reach is enlarged
  double quat_min;
  const void *means, *quats, *scales, *covariances, *opacities;
  const double *K, *R, *t, *limits;  // [B, 3, 3] twice, [B, 3], [B, 4]: bounds of x/z and y/z
  double *out_means, *out_factors;
  void* out_opacities;
  double* out_depths;
  void* out_extents;
  uint8_t* visible;
  const double *g_means, *g_factors;
  const void* g_opacities;
  const double* g_depths;
  void *d_means, *d_quats, *d_scales, *d_covariances, *d_opacities;
  double *d_K, *d_R, *d_t, *d_limits;
};
}

namespace gsgan {

struct Vec3 {
  double x = 0, y = 0, z = 0;
};
inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator*(double s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
inline Vec3 times(Vec3 a, Vec3 b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
inline double dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(Vec3 a, Vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T> Vec3 read3(const T* p) { return {double(p[0]), double(p[1]), double(p[2])}; }
template <class T> void write3(T* p, Vec3 v) {
  p[0] = T(v.x);
  p[1] = T(v.y);
  p[2] = T(v.z);
}

struct Mat3 {  // by rows
  Vec3 x, y, z;
};
inline Vec3 operator*(const Mat3& m, Vec3 v) { return {dot(m.x, v), dot(m.y, v), dot(m.z, v)}; }
inline Vec3 transposed_times(const Mat3& m, Vec3 v) { return v.x * m.x + v.y * m.y + v.z * m.z; }
inline void add_outer(Mat3& m, Vec3 a, Vec3 b) {
  m.x = m.x + a.x * b;
  m.y = m.y + a.y * b;
  m.z = m.z + a.z * b;
}
template <class T> Mat3 read33(const T* p) { return {read3(p), read3(p + 3), read3(p + 6)}; }
template <class T> void write33(T* p, const Mat3& m) {
  write3(p, m.x);
  write3(p + 3, m.y);
  write3(p + 6, m.z);
}

// ---------------------------------------------------------------------------------------- rotation

struct Quat {
  double w = 0, x = 0, y = 0, z = 0;
};

// The quaternion divided by its largest component, so that squares neither underflow nor overflow.
// Noise gives the identity and `per_largest` 0: no gradient.
template <class T> Quat read_quat(const T* p, double least, double& per_largest) {
  const double w = p[0], x = p[1], y = p[2], z = p[3];
  const double largest = std::fmax(std::fmax(std::abs(w), std::abs(x)),
                                   std::fmax(std::abs(y), std::abs(z)));
  const bool usable = largest > least;
  per_largest = usable ? 1 / largest : 0;
  return {usable ? w * per_largest : 1.0, x * per_largest, y * per_largest, z * per_largest};
}

inline double two_over_square(Quat q) { return 2 / (q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z); }

// R = identity + two * this.
inline Mat3 rotation_part(Quat q) {
  const double xx = q.x * q.x, yy = q.y * q.y, zz = q.z * q.z;
  const double xy = q.x * q.y, xz = q.x * q.z, yz = q.y * q.z;
  const double wx = q.w * q.x, wy = q.w * q.y, wz = q.w * q.z;
  return {{-(yy + zz), xy - wz, xz + wy}, {xy + wz, -(xx + zz), yz - wx}, {xz - wy, yz + wx, -(xx + yy)}};
}

inline Mat3 rotation(Quat q) {
  const double two = two_over_square(q);
  const Mat3 m = rotation_part(q);
  return {Vec3{1, 0, 0} + two * m.x, Vec3{0, 1, 0} + two * m.y, Vec3{0, 0, 1} + two * m.z};
}

inline Quat rotation_backward(Quat q, const Mat3& g) {
  const double two = two_over_square(q);
  const Mat3 m = rotation_part(q);
  const double of_two = dot(g.x, m.x) + dot(g.y, m.y) + dot(g.z, m.z);
  const double radial = -of_two * two;  // d two = -two^2 sum of q dq, over two
  const Vec3 odd{g.z.y - g.y.z, g.x.z - g.z.x, g.y.x - g.x.y};
  const double xy = g.x.y + g.y.x, xz = g.x.z + g.z.x, yz = g.y.z + g.z.y;
  const double w = odd.x * q.x + odd.y * q.y + odd.z * q.z;
  const double x = odd.x * q.w + xy * q.y + xz * q.z - 2 * (g.y.y + g.z.z) * q.x;
  const double y = odd.y * q.w + xy * q.x + yz * q.z - 2 * (g.x.x + g.z.z) * q.y;
  const double z = odd.z * q.w + xz * q.x + yz * q.y - 2 * (g.x.x + g.y.y) * q.z;
  return {two * (w + radial * q.w), two * (x + radial * q.x), two * (y + radial * q.y),
          two * (z + radial * q.z)};
}

// ------------------------------------------------------------------------------------------ camera

struct Camera {
  Vec3 k0, k1;  // the upper rows of K
  Mat3 R;
  Vec3 t;
  double low_x, low_y, high_x, high_y;
  Vec3 kr0, kr1;  // upper left of K times the upper rows of R

  Camera(const ProjectJob& job, int64_t b)
      : k0(read3(job.K + 9 * b)), k1(read3(job.K + 9 * b + 3)), R(read33(job.R + 9 * b)),
        t(read3(job.t + 3 * b)), low_x(job.limits[4 * b]), low_y(job.limits[4 * b + 1]),
        high_x(job.limits[4 * b + 2]), high_y(job.limits[4 * b + 3]),
        kr0(k0.x * R.x + k0.y * R.y), kr1(k1.x * R.x + k1.y * R.y) {}
};

// Sums over Gaussians; kr0, kr1 are converted to gradients of K and R at the end.
struct CameraGradient {
  Vec3 k0, k1, t, kr0, kr1;
  Mat3 R;
  double low_x = 0, low_y = 0, high_x = 0, high_y = 0;

  void add(const CameraGradient& o) {
    k0 = k0 + o.k0, k1 = k1 + o.k1, t = t + o.t, kr0 = kr0 + o.kr0, kr1 = kr1 + o.kr1;
    R.x = R.x + o.R.x, R.y = R.y + o.R.y, R.z = R.z + o.R.z;
    low_x += o.low_x, low_y += o.low_y, high_x += o.high_x, high_y += o.high_y;
  }
};

// A mean in front of the camera, its pixel, and the Jacobian of the projection there.
struct View {
  double z, per_z, x, y;        // depth, 1 / depth, x/z, y/z
  double cx, cy;                // x/z and y/z, clamped
  double along_x, along_y;      // upper left of K times those
  Vec3 j0, j1;                  // pixels per metre of world

  View(const Camera& c, Vec3 at)
      : z(at.z), per_z(1 / at.z), x(at.x * per_z), y(at.y * per_z),
        cx(std::fmin(std::fmax(x, c.low_x), c.high_x)),
        cy(std::fmin(std::fmax(y, c.low_y), c.high_y)),
        along_x(c.k0.x * cx + c.k0.y * cy), along_y(c.k1.x * cx + c.k1.y * cy),
        j0(per_z * (c.kr0 - along_x * c.R.z)), j1(per_z * (c.kr1 - along_y * c.R.z)) {}

  double pixel_x(const Camera& c) const { return c.k0.x * x + c.k0.y * y + c.k0.z; }
  double pixel_y(const Camera& c) const { return c.k1.x * x + c.k1.y * y + c.k1.z; }

  // Gradient of the mean in camera axes, given those of its pixel, the Jacobian and the depth.
  Vec3 backward(const Camera& c, double g_x, double g_y, Vec3 g_j0, Vec3 g_j1, double g_z,
                CameraGradient& sum) const {
    const Vec3 e0 = per_z * g_j0, e1 = per_z * g_j1;
    const double along_x_grad = -dot(e0, c.R.z), along_y_grad = -dot(e1, c.R.z);
    sum.kr0 = sum.kr0 + e0;
    sum.kr1 = sum.kr1 + e1;
    sum.R.z = sum.R.z - (along_x * e0 + along_y * e1);
    sum.k0 = sum.k0 + Vec3{along_x_grad * cx + g_x * x, along_x_grad * cy + g_x * y, g_x};
    sum.k1 = sum.k1 + Vec3{along_y_grad * cx + g_y * x, along_y_grad * cy + g_y * y, g_y};
    const double cx_grad = c.k0.x * along_x_grad + c.k1.x * along_y_grad;
    const double cy_grad = c.k0.y * along_x_grad + c.k1.y * along_y_grad;
    sum.low_x += x < c.low_x ? cx_grad : 0;
    sum.high_x += x > c.high_x ? cx_grad : 0;
    sum.low_y += y < c.low_y ? cy_grad : 0;
    sum.high_y += y > c.high_y ? cy_grad : 0;
    const double x_grad = c.k0.x * g_x + c.k1.x * g_y + (cx == x ? cx_grad : 0);
    const double y_grad = c.k0.y * g_x + c.k1.y * g_y + (cy == y ? cy_grad : 0);
    const double z_grad =
        g_z - per_z * (x_grad * x + y_grad * y + dot(g_j0, j0) + dot(g_j1, j1));
    return {per_z * x_grad, per_z * y_grad, z_grad};
  }
};

// ------------------------------------------------------------------------------------------- shape

struct Cov2 {  // [a b; b c] and its determinant
  double a, b, c, det;
};

// J Sigma J^T for a rotation and scales. Its determinant is |u x v|^2, a sum of squares: a c - b^2
// would cancel.
struct RotatedScales {
  Quat q;
  double per_largest;
  Vec3 s;
  Mat3 R;
  Vec3 h, g, u, v;

  template <class T>
  RotatedScales(const T* quat, const T* scale, double quat_min, const View& view)
      : q(read_quat(quat, quat_min, per_largest)), s(read3(scale)), R(rotation(q)),
        h(transposed_times(R, view.j0)), g(transposed_times(R, view.j1)), u(times(h, s)),
        v(times(g, s)) {}

  Cov2 covariance() const {
    const Vec3 w = cross(u, v);
    return {dot(u, u), dot(u, v), dot(v, v), dot(w, w)};
  }

  template <class T>
  void backward(const View& view, Cov2 grad, Vec3& j0, Vec3& j1, T* quat, T* scale) const {
    const Vec3 w = (2 * grad.det) * cross(u, v);
    const Vec3 gu = (2 * grad.a) * u + grad.b * v + cross(v, w);
    const Vec3 gv = (2 * grad.c) * v + grad.b * u + cross(w, u);
    const Vec3 gh = times(gu, s), gg = times(gv, s);
    j0 = R * gh;
    j1 = R * gg;
    if (scale) write3(scale, times(gu, h) + times(gv, g));
    if (!quat) return;
    Mat3 gR;
    add_outer(gR, view.j0, gh);
    add_outer(gR, view.j1, gg);
    const Quat r = rotation_backward(q, gR);
    quat[0] = T(per_largest * r.w);
    quat[1] = T(per_largest * r.x);
    quat[2] = T(per_largest * r.y);
    quat[3] = T(per_largest * r.z);
  }
};

// J Sigma J^T for a covariance, which need not be symmetric or positive definite.
struct GivenCovariance {
  Mat3 twice;  // Sigma + its transpose
  Cov2 raw;

  template <class T> GivenCovariance(const T* p, const View& view) {
    const Mat3 m = read33(p);
    twice = {m.x + Vec3{m.x.x, m.y.x, m.z.x}, m.y + Vec3{m.x.y, m.y.y, m.z.y},
             m.z + Vec3{m.x.z, m.y.z, m.z.z}};
    const Vec3 s0 = twice * view.j0, s1 = twice * view.j1;
    raw = {0.5 * dot(s0, view.j0), 0.5 * dot(s0, view.j1), 0.5 * dot(s1, view.j1), 0};
    raw.det = std::fmax(raw.a, 0.0) * std::fmax(raw.c, 0.0) - raw.b * raw.b;
  }

  Cov2 covariance() const {
    return {std::fmax(raw.a, 0.0), raw.b, std::fmax(raw.c, 0.0), std::fmax(raw.det, 0.0)};
  }

  template <class T> void backward(const View& view, Cov2 g, Vec3& j0, Vec3& j1, T* out) const {
    const Cov2 at = covariance();
    const double det = raw.det >= 0 ? g.det : 0;
    const double a = raw.a >= 0 ? g.a + det * at.c : 0, c = raw.c >= 0 ? g.c + det * at.a : 0;
    const double b = 0.5 * (g.b - 2 * det * at.b);
    j0 = twice * (a * view.j0 + b * view.j1);
    j1 = twice * (c * view.j1 + b * view.j0);
    if (!out) return;
    Mat3 m;
    add_outer(m, a * view.j0 + b * view.j1, view.j0);
    add_outer(m, c * view.j1 + b * view.j0, view.j1);
    write33(out, m);
  }
};

// ----------------------------------------------------------------------------------------- ellipse

// The low-passed covariance, its factors (p, k, r), and the opacity's anti-aliasing factor.
struct Blurred {
  Cov2 before, after;
  double p, k, r, kept;

  Blurred(Cov2 cov, double low_pass, bool antialias) : before(cov) {
    after.det = cov.det + low_pass * (cov.a + cov.c) + low_pass * low_pass;
    after.b = cov.b;
    after.c = cov.c + low_pass;
    after.a = (cov.b * cov.b + after.det) / after.c;
    p = std::sqrt(after.c / after.det);
    k = -cov.b / after.c;
    r = 1 / std::sqrt(after.c);
    kept = antialias ? std::sqrt(cov.det / after.det) : 1;
  }

  Cov2 backward(double g_p, double g_k, double g_r, double g_kept, double low_pass) const {
    const double half = 0.5 * kept * g_kept, det = -0.5 * (g_p * p + 2 * half) / after.det;
    const double c = (0.5 * (g_p * p - g_r * r) - g_k * k) / after.c;
    const double of_before = before.det > 0 ? half / before.det : 0;
    return {low_pass * det, -g_k / after.c, low_pass * det + c, det + of_before};
  }
};

}  // namespace gsgan
