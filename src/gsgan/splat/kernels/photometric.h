// L1, squared error and D-SSIM of two images with the gradient of the first, one plane (a channel of
// a batch item) at a time. Definitions: losses/photometric.py, whose tensor operations are the
// reference; the gradient is the adjoint of each step.
#pragma once

#include <cmath>
#include <cstdint>
#include <new>
#include <vector>

extern "C" {

// Mirrors losses/photometric.py's _Job. Planes are contiguous; d_image is null when not needed.
struct PhotometricJob {
  int64_t planes, H, W, threads;
  double l1, l2, ssim;
  const void *image, *target;
  void* d_image;   // of the mean over all planes
  double* totals;  // [planes] sums over pixels
};
}

namespace gsgan {

constexpr int SPAN = 11, REACH = SPAN / 2;  // the Gaussian window, pixels
constexpr double SIGMA = 1.5, K1 = 0.01, K2 = 0.03;

template <class T> struct Window {
  Window() {
    double sum = 0, w[SPAN];
    for (int k = 0; k < SPAN; ++k)
      sum += w[k] = std::exp(-0.5 * (k - REACH) * (k - REACH) / (SIGMA * SIGMA));
    for (int k = 0; k < SPAN; ++k) weight[k] = T(w[k] / sum);
  }
  T weight[SPAN];
};

inline int64_t reflected(int64_t i, int64_t n) { return i < 0 ? -i : i >= n ? 2 * n - 2 - i : i; }

// The windowed mean of a plane at row y; padded: [W + 2 REACH] of scratch.
template <class T>
void window_row(const Window<T>& window, const T* plane, int64_t y, int64_t H, int64_t W, T* padded,
                T* out) {
  const T* rows[SPAN];
  for (int k = 0; k < SPAN; ++k) rows[k] = plane + reflected(y + k - REACH, H) * W;
  T* middle = padded + REACH;
  for (int64_t x = 0; x < W; ++x) {
    T sum = 0;
    for (int k = 0; k < SPAN; ++k) sum += window.weight[k] * rows[k][x];
    middle[x] = sum;
  }
  for (int i = 1; i <= REACH; ++i) {
    middle[-i] = middle[i];
    middle[W - 1 + i] = middle[W - 1 - i];
  }
  for (int64_t x = 0; x < W; ++x) {
    T sum = 0;
    for (int k = 0; k < SPAN; ++k) sum += window.weight[k] * padded[x + k];
    out[x] = sum;
  }
}

// The adjoint of `window_row`: adds what row y's gradient gives to the plane's. Row: [W + 4 REACH],
// zeros but for the gradient in its middle; spread: [W + 2 REACH] of scratch.
template <class T>
void window_row_adjoint(const Window<T>& window, const T* row, int64_t y, int64_t H, int64_t W,
                        T* spread, T* plane) {
  for (int64_t x = 0; x < W + 2 * REACH; ++x) {
    T sum = 0;
    for (int k = 0; k < SPAN; ++k) sum += window.weight[k] * row[x + k];
    spread[x] = sum;
  }
  T* middle = spread + REACH;
  for (int i = 1; i <= REACH; ++i) {
    middle[i] += middle[-i];
    middle[W - 1 - i] += middle[W - 1 + i];
  }
  for (int k = 0; k < SPAN; ++k) {
    T* to = plane + reflected(y + k - REACH, H) * W;
    for (int64_t x = 0; x < W; ++x) to[x] += window.weight[k] * middle[x];
  }
}

// D-SSIM of one plane: adds to total [W], and to the gradient (null: not needed).
template <class T>
void d_ssim_plane(const T* image, const T* target, int64_t H, int64_t W, T weight, double* total,
                  T* gradient) {
  static const Window<T> window;
  const int64_t n = H * W, wide = W + 4 * REACH;
  double image_sum = 0, target_sum = 0;
  for (int64_t i = 0; i < n; ++i) image_sum += image[i], target_sum += target[i];
  // Variances are about each plane's mean: the usual form cancels where images are flat or equal.
  const T middle = T(image_sum / n), other = T(target_sum / n), shift = middle - other;
  std::vector<T> moments(4 * n), rows(4 * W + wide), adjoint(gradient ? 3 * n : 0);
  T *x = moments.data(), *d = x + n, *power = d + n, *gap_power = power + n;
  for (int64_t i = 0; i < n; ++i) {
    const T a = image[i] - middle, b = target[i] - other;
    x[i] = a;
    d[i] = (image[i] - target[i]) - shift;
    power[i] = a * a + b * b;
    gap_power[i] = d[i] * d[i];
  }
  T *mx = rows.data(), *md = mx + W, *mp = md + W, *mq = mp + W, *scratch = mq + W;
  std::vector<T> slopes(gradient ? 3 * wide : 0);
  T *by_x = slopes.data() + 2 * REACH, *by_power = by_x + wide, *by_gap = by_power + wide;
  const T c1 = T(K1 * K1), c2 = T(K2 * K2);
  for (int64_t y = 0; y < H; ++y) {
    const T* planes[] = {x, d, power, gap_power};
    T* means[] = {mx, md, mp, mq};
    for (int k = 0; k < 4; ++k) window_row(window, planes[k], y, H, W, scratch, means[k]);
    for (int64_t i = 0; i < W; ++i) {
      const T my = mx[i] - md[i], V = mp[i] - mx[i] * mx[i] - my * my + c2;
      const T structure = (mq[i] - md[i] * md[i]) / V;
      const T M = mx[i] + middle, g = md[i] + shift, D = M * M + (M - g) * (M - g) + c1;
      const T luminance = g * g / D;
      total[i] += double(weight * (luminance + structure - luminance * structure));
      if (!gradient) continue;
      const T a = 1 - structure, b = 1 - luminance;
      // the windowed means of x and of x - y both move with the image
      const T by_luminance = (2 * g - luminance * 2 * M) / D;
      const T by_structure = (structure * 2 * mx[i] - 2 * md[i]) / V;
      by_x[i] = a * by_luminance + b * by_structure;
      by_power[i] = -b * structure / V;
      by_gap[i] = b / V;
    }
    if (!gradient) continue;
    T* from[] = {by_x, by_power, by_gap};
    for (int k = 0; k < 3; ++k)
      window_row_adjoint(window, from[k] - 2 * REACH, y, H, W, scratch, adjoint.data() + k * n);
  }
  for (int64_t i = 0; gradient && i < n; ++i)
    gradient[i] += weight * (adjoint[i] + 2 * x[i] * adjoint[n + i] + 2 * d[i] * adjoint[2 * n + i]);
}

template <class T> void photometric_plane(const PhotometricJob& job, int64_t plane) {
  const int64_t n = job.H * job.W;
  const T* image = static_cast<const T*>(job.image) + plane * n;
  const T* target = static_cast<const T*>(job.target) + plane * n;
  T* gradient = job.d_image ? static_cast<T*>(job.d_image) + plane * n : nullptr;
  std::vector<double> total(job.W, 0.0);  // by column: as many sums as a register holds, and more
  const T l1 = T(job.l1), l2 = T(job.l2);
  for (int64_t y = 0; y < job.H; ++y)
    for (int64_t x = 0; x < job.W; ++x) {
      const T d = image[y * job.W + x] - target[y * job.W + x];
      total[x] += double(l1 * std::fabs(d) + l2 * d * d);
      if (gradient) gradient[y * job.W + x] = l1 * T((d > 0) - (d < 0)) + 2 * l2 * d;
    }
  if (job.ssim != 0)
    d_ssim_plane(image, target, job.H, job.W, T(job.ssim), total.data(), gradient);
  double sum = 0;
  for (const double t : total) sum += t;
  job.totals[plane] = sum;
  const T share = T(1.0 / double(job.planes * n));
  for (int64_t i = 0; gradient && i < n; ++i) gradient[i] *= share;
}

template <class T> int photometric(const PhotometricJob& job) {
  bool failed = false;
#pragma omp parallel for schedule(dynamic, 1) num_threads(int(job.threads)) reduction(|| : failed)
  for (int64_t plane = 0; plane < job.planes; ++plane) {
    try {
      photometric_plane<T>(job, plane);
    } catch (const std::bad_alloc&) {
      failed = true;
    }
  }
  return failed;
}

}  // namespace gsgan
