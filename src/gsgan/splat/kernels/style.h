// Normalises the channels of each pixel, scales, shifts, and applies a leaky ReLU: one row of C
// channels at a time. Definitions: model/generator.py, whose tensor operations are the reference.
#pragma once

#include <cmath>
#include <cstdint>

extern "C" {

// Mirrors model/compiled.py's _StyleJob. modulation: rows of [scale - 1, shift], 2 C numbers.
struct StyleJob {
  int64_t rows, C, threads;
  double floor, slope;
  const void *h, *modulation;
  void* out;  // read by the backward pass
  const void* g;
  void *d_h, *d_modulation;
};
}

namespace gsgan {

template <class T> T inverse_norm(const T* h, int64_t C, T floor) {
  T sum = 0;
#pragma omp simd reduction(+ : sum)
  for (int64_t c = 0; c < C; ++c) sum += h[c] * h[c];
  return 1 / std::sqrt(sum / T(C) + floor);
}

template <class T> int style(const StyleJob& job) {
  const int64_t C = job.C;
  const T floor = T(job.floor), slope = T(job.slope);
#pragma omp parallel for schedule(static) num_threads(int(job.threads))
  for (int64_t i = 0; i < job.rows; ++i) {
    const T *h = static_cast<const T*>(job.h) + i * C;
    const T *scale = static_cast<const T*>(job.modulation) + 2 * i * C, *shift = scale + C;
    T* out = static_cast<T*>(job.out) + i * C;
    const T r = inverse_norm(h, C, floor);
#pragma omp simd
    for (int64_t c = 0; c < C; ++c) {
      const T v = h[c] * r * (1 + scale[c]) + shift[c];
      out[c] = v > 0 ? v : slope * v;
    }
  }
  return 0;
}

template <class T> int style_backward(const StyleJob& job) {
  const int64_t C = job.C;
  const T floor = T(job.floor), slope = T(job.slope);
#pragma omp parallel for schedule(static) num_threads(int(job.threads))
  for (int64_t i = 0; i < job.rows; ++i) {
    const T *h = static_cast<const T*>(job.h) + i * C, *g = static_cast<const T*>(job.g) + i * C;
    const T *scale = static_cast<const T*>(job.modulation) + 2 * i * C;
    const T* out = static_cast<const T*>(job.out) + i * C;
    T *d_h = static_cast<T*>(job.d_h) + i * C;
    T *d_scale = static_cast<T*>(job.d_modulation) + 2 * i * C, *d_shift = d_scale + C;
    const T r = inverse_norm(h, C, floor);
    T along = 0;
#pragma omp simd reduction(+ : along)
    for (int64_t c = 0; c < C; ++c) {
      const T back = out[c] > 0 ? g[c] : slope * g[c], unit = h[c] * r;
      d_shift[c] = back;
      d_scale[c] = back * unit;
      d_h[c] = back * (1 + scale[c]);
      along += d_h[c] * unit;
    }
    along /= T(C);
#pragma omp simd
    for (int64_t c = 0; c < C; ++c) d_h[c] = r * (d_h[c] - h[c] * r * along);
  }
  return 0;
}

}  // namespace gsgan
