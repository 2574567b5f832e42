// Forward pass: front to back, with the transmittance in a register; a chunk's weights are stored,
// then applied to the channels in groups.
#pragma once

#include "tile.h"

namespace gsgan {

// image[c] += sum over i of w_i f_ic, for G channels of one register of pixels.
template <class T, int G>
void add_channels(const T* weights, const int32_t* list, int n, const T* features, int64_t stride,
                  T* image) {
  using V = Vec<T>;
  constexpr int W = Simd<T>::W;
  V acc[G];
  for (int g = 0; g < G; ++g) acc[g] = load(image + g * PIXELS);
  for (int i = 0; i < n; ++i) {
    const V w = load(weights + i * W);
    const T* f = features + list[i] * stride;
    for (int g = 0; g < G; ++g) acc[g] += w * f[g];
  }
  for (int g = 0; g < G; ++g) store(image + g * PIXELS, acc[g]);
}

// Composites a chunk into one cell. Returns false when all its pixels have stopped.
template <class T>
bool forward_cell(int cell, int64_t channels, const Cutoffs<T>& cut, Scratch<T>& s) {
  using V = Vec<T>;
  constexpr int W = Simd<T>::W;
  constexpr int PATIENCE = 8;  // entries between checks whether all pixels have stopped
  const int n = s.length[cell];
  const int32_t* list = s.list[cell];
  bool alive = false;
  for (int sub = 0; sub < SUBS<T>; ++sub) {
    const Pixels<T> p = pixels_of<T>(cell, sub);
    T* t_at = s.transmittance.get() + cell * LANES + sub * W;
    V t = load(t_at);
    bool going = true;
    int i = 0;
    while (i < n && (going = any_at_least<T>(t, cut.transmittance_min))) {
      const int end = std::min(n, i + PATIENCE);
      for (; i < end; ++i) {
        const Hit<T> h = hit(s, list[i], p, t, cut);
        store(s.weights.get() + i * W, h.alpha * t);
        t *= T(1) - h.alpha;
      }
    }
    store(t_at, t);
    alive |= going;
    const int done = i;
    in_groups(channels, [&](int64_t c, auto size) {
      add_channels<T, decltype(size)::value>(
          s.weights.get(), list, done, s.features.get() + c, channels,
          s.image.get() + c * PIXELS + cell * LANES + sub * W);
    });
  }
  return alive;
}

template <class T> void start_transmittance(const Tile& t, T* to) {
  for (int y = 0; y < TILE; ++y)  // pixels outside the image have stopped: -1 is below any bound
    for (int x = 0; x < TILE; ++x) to[pixel_of(x, y)] = x < t.width && y < t.height ? T(1) : T(-1);
}

template <class T>
void forward_tile(const Job& job, const Inputs<T>& in, Plan<T>& plan, int64_t index,
                  Scratch<T>& s) {
  const int64_t start = plan.tile_start[index], end = plan.tile_start[index + 1];
  if (start == end) return;
  const Tile tile = tile_at(job, plan, index);
  const int64_t plane = job.H * job.W, channels = job.C;
  T* features = static_cast<T*>(job.out_features) + tile.b * job.C * plane;
  T* alpha = static_cast<T*>(job.out_alpha) + tile.b * (plane / (job.times * job.times));
  const Cutoffs<T> cut(job);
  start_transmittance(tile, s.transmittance.get());
  std::fill_n(s.image.get(), channels * PIXELS, T(0));
  uint32_t alive = (1u << CELLS) - 1;
  int chunk = 0;
  for (int64_t at = start; at < end && alive; at += CHUNK, ++chunk) {
    if (job.keep)
      std::memcpy(plan.checkpoints.get() + (plan.chunk_start[index] + chunk) * PIXELS,
                  s.transmittance.get(), PIXELS * sizeof(T));
    const int n = int(std::min<int64_t>(CHUNK, end - at));
    load_chunk(job, in, plan, tile, at, n, channels, alive, false, s);
    for (int cell = 0; cell < CELLS; ++cell)
      if (s.length[cell] && !forward_cell(cell, channels, cut, s)) alive &= ~(1u << cell);
  }
  plan.chunks_done[index] = chunk;
  for (int k = 0; k < PIXELS; ++k) s.transmittance[k] = T(1) - s.transmittance[k];
  if (job.rows)
    write_pixels(features, job.W, job.C, tile, s.image.get());
  else
    for (int64_t c = 0; c < job.C; ++c)
      write_plane(features + c * plane, job.W, tile, s.image.get() + c * PIXELS);
  if (job.times == 1) {
    write_plane(alpha, job.W, tile, s.transmittance.get());
    return;
  }
  const int64_t coarse = plane / (job.times * job.times);
  T* average = static_cast<T*>(job.out_average) + tile.b * job.C * coarse;
  for (int64_t c = 0; c < job.C; ++c)
    write_average(average + c * coarse, job.W, job.times, tile, s.image.get() + c * PIXELS);
  write_average(alpha, job.W, job.times, tile, s.transmittance.get());
}

}  // namespace gsgan
