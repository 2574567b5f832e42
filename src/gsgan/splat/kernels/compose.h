// Raw residuals to the geometry of Gaussians, one point at a time, in double: forward and backward.
// Definitions: model/residual_gaussians.py, whose tensor operations are the reference.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "simd.h"

extern "C" {

// Mirrors model/compiled.py's _Job. Rows of raw begin with RESIDUALS numbers: mean 3,
// quaternion 4, scale 3, opacity 1. Null gradients are zero.
struct ComposeJob {
  int64_t count, threads;
  int64_t stride;                         // numbers in a row of raw
  double mean_bound;                      // metres; 0: unbounded
  double unit;                            // metres of an unbounded residual of 1
  double scale_low, scale_high;           // of the logarithm
  double logit, logit_bound;
  const void *raw, *means, *frames, *shapes, *scales;
  const uint8_t* valid;
  void *out_means, *out_covariances, *out_opacities;
  const void *g_means, *g_covariances, *g_opacities;
  void* d_raw;                            // [count, 11]
};
}

namespace gsgan {

constexpr int RESIDUALS = 11;
constexpr int COMPOSE_BLOCK = 64;  // points whose exponentials are computed together
constexpr double NO_TURN = 1e-15;  // a shorter quaternion turns nothing, and has no slope
constexpr double LOG2_E = 1.4426950408889634;

inline double within(double x, double low, double high) {
  return x < low ? low : x > high ? high : x;
}

// The gradient of a bounded value: 0 where a step against it would lead further out.
inline double leading_back(double x, double low, double high, double g) {
  return (x > high && g < 0) || (x < low && g > 0) ? 0 : g;
}

// exp of numbers that are not positive, in place; the count is a multiple of a register's lanes.
INLINE void exp_of_negative(double* x, int count) {
  for (int i = 0; i < count; i += Simd<double>::W)
    store(x + i, exp2_of_negative<double>(load(x + i) * LOG2_E));
}

// The exponentials of a block of points, by register: libm's, one by one, take longer than all else.
struct Exponentials {
  double start[COMPOSE_BLOCK];                 // logarithm of the size at rest
  alignas(64) double mean[3][COMPOSE_BLOCK];   // exp(-2 |residual|)
  alignas(64) double scale[3][COMPOSE_BLOCK];  // exp(bounded logarithm - largest logarithm)
  alignas(64) double logit[COMPOSE_BLOCK];     // exp(-|bounded logit|)
};

template <class T>
void exponentials(const ComposeJob& job, int64_t first, int count, Exponentials& e) {
  for (int j = 0; j < COMPOSE_BLOCK; ++j) {
    const int64_t i = first + std::min(j, count - 1);  // the last point fills the block
    const T* raw = static_cast<const T*>(job.raw) + i * job.stride;
    e.start[j] = std::log(double(static_cast<const T*>(job.scales)[i]));
    for (int k = 0; k < 3; ++k) {
      e.mean[k][j] = -2 * std::abs(double(raw[k]));
      e.scale[k][j] =
          within(e.start[j] + raw[7 + k], job.scale_low, job.scale_high) - job.scale_high;
    }
    e.logit[j] = -std::abs(within(job.logit + raw[10], -job.logit_bound, job.logit_bound));
  }
  for (int k = 0; k < 3; ++k) {
    exp_of_negative(e.mean[k], COMPOSE_BLOCK);
    exp_of_negative(e.scale[k], COMPOSE_BLOCK);
  }
  exp_of_negative(e.logit, COMPOSE_BLOCK);
}

// One point's intermediate values.
struct Composed {
  double F[9], bent[3], offset[3];       // frame; mean's residual, bounded and in metres
  double S[9];                           // what shapes are transformed by
  double n[4], length, R[9];             // quaternion and its rotation
  double log_scale[3], scale[3], A[9];   // A = S R diag(scale)
  double logit, opacity;
};

// Point i, the j-th of a block; largest: the largest scale.
template <class T>
Composed composed(const ComposeJob& job, int64_t i, const Exponentials& e, int j, double largest) {
  const T* raw = static_cast<const T*>(job.raw) + i * job.stride;
  const T* frame = static_cast<const T*>(job.frames) + 9 * i;
  const T* shape = static_cast<const T*>(job.shapes) + 9 * i;
  Composed c;
  for (int k = 0; k < 9; ++k) c.F[k] = frame[k], c.S[k] = shape[k];
  for (int k = 0; k < 3; ++k) {
    const double tanh = std::copysign((1 - e.mean[k][j]) / (1 + e.mean[k][j]), double(raw[k]));
    c.bent[k] = job.mean_bound > 0 ? tanh : double(raw[k]);
    c.offset[k] = c.bent[k] * (job.mean_bound > 0 ? job.mean_bound : job.unit);
  }
  const double q[4] = {1.0 + raw[3], double(raw[4]), double(raw[5]), double(raw[6])};
  c.length = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int k = 0; k < 4; ++k) c.n[k] = c.length > NO_TURN ? q[k] / c.length : 0;
  const double w = c.n[0], x = c.n[1], y = c.n[2], z = c.n[3];
  const double R[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                       2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                       2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
  for (int k = 0; k < 9; ++k) c.R[k] = R[k];
  for (int k = 0; k < 3; ++k) {
    c.log_scale[k] = e.start[j] + raw[7 + k];
    c.scale[k] = largest * e.scale[k][j];
  }
  for (int r = 0; r < 9; r += 3)
    for (int k = 0; k < 3; ++k)
      c.A[r + k] = (c.S[r] * R[k] + c.S[r + 1] * R[3 + k] + c.S[r + 2] * R[6 + k]) * c.scale[k];
  c.logit = job.logit + raw[10];
  c.opacity = (c.logit < 0 ? e.logit[j] : 1) / (1 + e.logit[j]);
  return c;
}

template <class T> void compose_one(const ComposeJob& job, int64_t i, const Composed& c) {
  const T* mean = static_cast<const T*>(job.means) + 3 * i;
  T* out_mean = static_cast<T*>(job.out_means) + 3 * i;
  T* covariance = static_cast<T*>(job.out_covariances) + 9 * i;
  for (int r = 0; r < 3; ++r) {
    const double *F = c.F + 3 * r, *a = c.A + 3 * r;
    out_mean[r] = T(mean[r] + F[0] * c.offset[0] + F[1] * c.offset[1] + F[2] * c.offset[2]);
    for (int k = 0; k < 3; ++k) {
      const double* b = c.A + 3 * k;
      covariance[3 * r + k] = T(a[0] * b[0] + a[1] * b[1] + a[2] * b[2]);
    }
  }
  static_cast<T*>(job.out_opacities)[i] = T(job.valid[i] ? c.opacity : 0);
}

template <class T> void compose_one_backward(const ComposeJob& job, int64_t i, const Composed& c) {
  T* out = static_cast<T*>(job.d_raw) + RESIDUALS * i;
  for (int k = 0; k < RESIDUALS; ++k) out[k] = 0;
  if (job.g_means) {
    const T* g = static_cast<const T*>(job.g_means) + 3 * i;
    for (int k = 0; k < 3; ++k) {
      const double back = c.F[k] * g[0] + c.F[3 + k] * g[1] + c.F[6 + k] * g[2];
      const double slope = 1 - c.bent[k] * c.bent[k];
      out[k] = T(back * (job.mean_bound > 0 ? job.mean_bound * slope : job.unit));
    }
  }
  if (job.g_covariances) {
    const T* g = static_cast<const T*>(job.g_covariances) + 9 * i;
    double M[9];  // the gradient of R diag(scale): Sᵀ (G + Gᵀ) A
    for (int r = 0; r < 3; ++r)
      for (int k = 0; k < 3; ++k) {
        M[3 * r + k] = 0;
        for (int a = 0; a < 3; ++a)
          for (int b = 0; b < 3; ++b)
            M[3 * r + k] +=
                c.S[3 * a + r] * (double(g[3 * a + b]) + g[3 * b + a]) * c.A[3 * b + k];
      }
    for (int k = 0; k < 3; ++k) {
      const double by_scale = M[k] * c.R[k] + M[3 + k] * c.R[3 + k] + M[6 + k] * c.R[6 + k];
      out[7 + k] = T(leading_back(c.log_scale[k], job.scale_low, job.scale_high,
                                  by_scale * c.scale[k]));
    }
    for (int k = 0; k < 9; ++k) M[k] *= c.scale[k % 3];
    const double w = c.n[0], x = c.n[1], y = c.n[2], z = c.n[3];
    const double d[4] = {
        2 * (-z * M[1] + y * M[2] + z * M[3] - x * M[5] - y * M[6] + x * M[7]),
        2 * (y * M[1] + z * M[2] + y * M[3] - 2 * x * M[4] - w * M[5] + z * M[6] + w * M[7] -
             2 * x * M[8]),
        2 * (-2 * y * M[0] + x * M[1] + w * M[2] + x * M[3] + z * M[5] - w * M[6] + z * M[7] -
             2 * y * M[8]),
        2 * (-2 * z * M[0] - w * M[1] + x * M[2] + w * M[3] - 2 * z * M[4] + y * M[5] + x * M[6] +
             y * M[7])};
    const double along = w * d[0] + x * d[1] + y * d[2] + z * d[3];
    for (int k = 0; k < 4 && c.length > NO_TURN; ++k)
      out[3 + k] = T((d[k] - c.n[k] * along) / c.length);
  }
  if (job.g_opacities && job.valid[i]) {
    const double g = static_cast<const T*>(job.g_opacities)[i];
    out[10] = T(leading_back(c.logit, -job.logit_bound, job.logit_bound,
                             g * c.opacity * (1 - c.opacity)));
  }
}

template <class T, class F> void compose_all(const ComposeJob& job, F&& f) {
  const int64_t blocks = (job.count + COMPOSE_BLOCK - 1) / COMPOSE_BLOCK;
  const double largest = std::exp(job.scale_high);
#pragma omp parallel for schedule(static) num_threads(int(job.threads))
  for (int64_t block = 0; block < blocks; ++block) {
    const int64_t first = block * COMPOSE_BLOCK;
    const int count = int(std::min<int64_t>(COMPOSE_BLOCK, job.count - first));
    Exponentials e;
    exponentials<T>(job, first, count, e);
    for (int j = 0; j < count; ++j) f(first + j, composed<T>(job, first + j, e, j, largest));
  }
}

template <class T> int compose(const ComposeJob& job) {
  compose_all<T>(job, [&](int64_t i, const Composed& c) { compose_one<T>(job, i, c); });
  return 0;
}

template <class T> int compose_backward(const ComposeJob& job) {
  compose_all<T>(job, [&](int64_t i, const Composed& c) { compose_one_backward<T>(job, i, c); });
  return 0;
}

}  // namespace gsgan
