// Backward pass: chunks from back to front. The forward pass stored the transmittance before each
// chunk, so there is no division: alpha = 1 and a transmittance of 0 have exact gradients. With R_i
// the colour of the layers behind i alone,
//     dL/dalpha_i = T_i (v_i - R_i),   R_{i-1} = alpha_i v_i + (1 - alpha_i) R_i.
#pragma once

#include "tile.h"

namespace gsgan {

// v_i += sum over c of f_ic g_c, for G channels of one register of pixels.
template <class T, int G>
void add_values(T* values, const int32_t* list, int n, const T* features, int64_t stride,
                const T* grad) {
  using V = Vec<T>;
  constexpr int W = Simd<T>::W;
  V g[G];
  for (int c = 0; c < G; ++c) g[c] = load(grad + c * PIXELS);
  for (int i = 0; i < n; ++i) {
    const T* f = features + list[i] * stride;
    V v = load(values + i * W), odd = splat<T>(0);
    for (int c = 0; c + 1 < G; c += 2) {
      v += g[c] * f[c];
      odd += g[c + 1] * f[c + 1];
    }
    if (G % 2) v += g[G - 1] * f[G - 1];
    store(values + i * W, v + odd);
  }
}

template <class T> uint32_t alive_cells(const Scratch<T>& s, const Cutoffs<T>& cut) {
  uint32_t alive = 0;
  for (int k = 0; k < PIXELS; ++k)
    alive |= uint32_t(s.transmittance[k] >= cut.transmittance_min) << (k / LANES);
  return alive;
}

// Fills the records of a chunk for one cell.
template <class T>
void backward_cell(int cell, int64_t channels, const Cutoffs<T>& cut, Scratch<T>& s) {
  using V = Vec<T>;
  constexpr int W = Simd<T>::W;
  const int n = s.length[cell];
  const int32_t *list = s.list[cell], *record = s.record[cell];
  for (int sub = 0; sub < SUBS<T>; ++sub) {
    const Pixels<T> p = pixels_of<T>(cell, sub);
    const int lane = cell * LANES + sub * W;
    V t = load(s.transmittance.get() + lane);
    const V alpha_grad = load(s.alpha_grad.get() + lane);
    for (int i = 0; i < n; ++i) {
      const Hit<T> h = hit(s, list[i], p, t, cut);
      store(s.e.get() + i * W, h.e * t);
      store(s.alpha.get() + i * W, h.alpha);
      store(s.v.get() + i * W, alpha_grad);
      store(s.record_w.get() + record[i] * LANES + sub * W, h.alpha * t);
      t *= T(1) - h.alpha;
    }
    in_groups(channels, [&](int64_t c, auto size) {
      add_values<T, decltype(size)::value>(s.v.get(), list, n, s.features.get() + c, channels,
                                           s.image.get() + c * PIXELS + lane);
    });
    V behind = load(s.behind.get() + lane);
    for (int i = n - 1; i >= 0; --i) {
      const V difference = load(s.v.get() + i * W) - behind;
      store(s.record_g.get() + record[i] * LANES + sub * W, load(s.e.get() + i * W) * difference);
      behind += load(s.alpha.get() + i * W) * difference;
    }
    store(s.behind.get() + lane, behind);
  }
}

// Sums g, g u, g v, g u^2, g u v, g v^2 over an entry's records g = dL/dalpha exp(-q/2). The sums do
// not depend on the tile's position and add up over tiles; see `geometry_gradient`.
template <class T> void entry_geometry(int k, const Scratch<T>& s, T* out) {
  using V = Vec<T>;
  constexpr int W = Simd<T>::W;
  V acc[GEOMETRY] = {};
  const T* record = s.record_g.get() + s.first[k] * LANES;
  for (uint32_t mask = s.mask[k]; mask; mask &= mask - 1) {
    const int cell = __builtin_ctz(mask);
    for (int sub = 0; sub < SUBS<T>; ++sub, record += W) {
      const Whitened<T> at = whitened(s.place[k], pixels_of<T>(cell, sub));
      const V g = load(record), gu = g * at.u, gv = g * at.v;
      acc[0] += g;
      acc[1] += gu;
      acc[2] += gv;
      acc[3] += gu * at.u;
      acc[4] += gu * at.v;
      acc[5] += gv * at.v;
    }
  }
  sums<T, GEOMETRY>(acc, out);
}

// Sums an entry's records into its gradients with respect to G features.
template <class T, int G>
void entry_features(int k, const Scratch<T>& s, const T* grad, T* out) {
  using V = Vec<T>;
  constexpr int W = Simd<T>::W;
  V acc[G] = {};
  const T* record = s.record_w.get() + s.first[k] * LANES;
  for (uint32_t mask = s.mask[k]; mask; mask &= mask - 1) {
    const T* at = grad + __builtin_ctz(mask) * LANES;
    for (int sub = 0; sub < SUBS<T>; ++sub, record += W, at += W) {
      const V w = load(record);
      for (int g = 0; g < G; ++g) acc[g] += w * load(at + g * PIXELS);
    }
  }
  sums<T, G>(acc, out);
}

// Copies the incoming gradients of a tile; absent ones are 0.
template <class T> void load_gradients(const Job& job, const Tile& tile, Scratch<T>& s) {
  const int64_t plane = job.H * job.W;
  const auto read = [&](const void* planes, int64_t index, T* to) {
    if (planes)
      read_plane(static_cast<const T*>(planes) + index * plane, job.W, tile, to);
    else
      std::fill_n(to, PIXELS, T(0));
  };
  if (job.g_features && job.rows)
    read_pixels(static_cast<const T*>(job.g_features) + tile.b * job.C * plane, job.W, job.C, tile,
                s.image.get());
  else
    for (int64_t c = 0; c < job.C; ++c)
      read(job.g_features, tile.b * job.C + c, s.image.get() + c * PIXELS);
  if (job.times == 1) {
    read(job.g_alpha, tile.b, s.alpha_grad.get());
    return;
  }
  std::fill_n(s.alpha_grad.get(), PIXELS, T(0));
  const int64_t coarse = plane / (job.times * job.times);
  const auto spread = [&](const void* planes, int64_t index, T* to) {
    if (planes)
      add_spread(static_cast<const T*>(planes) + index * coarse, job.W, job.times, tile, to);
  };
  for (int64_t c = 0; c < job.C; ++c)
    spread(job.g_average, tile.b * job.C + c, s.image.get() + c * PIXELS);
  spread(job.g_alpha, tile.b, s.alpha_grad.get());
}

// Sums of a tile's entries; slots: [entries of the tile, GEOMETRY + channels].
template <class T>
void backward_tile(const Job& job, const Inputs<T>& in, const Plan<T>& plan, int64_t index,
                   Scratch<T>& s, T* slots) {
  const int64_t start = plan.tile_start[index], end = plan.tile_start[index + 1];
  if (start == end) return;
  const Tile tile = tile_at(job, plan, index);
  const int64_t channels = job.C, stride = GEOMETRY + channels;
  const Cutoffs<T> cut(job);
  load_gradients(job, tile, s);
  std::fill_n(s.behind.get(), PIXELS, T(0));
  const int64_t done = std::min(end, start + int64_t(plan.chunks_done[index]) * CHUNK);
  std::fill_n(slots + (done - start) * stride, (end - done) * stride, T(0));
  for (int chunk = plan.chunks_done[index] - 1; chunk >= 0; --chunk) {
    const int64_t at = start + int64_t(chunk) * CHUNK;
    const int n = int(std::min<int64_t>(CHUNK, end - at));
    std::memcpy(s.transmittance.get(),
                plan.checkpoints.get() + (plan.chunk_start[index] + chunk) * PIXELS,
                PIXELS * sizeof(T));
    load_chunk(job, in, plan, tile, at, n, channels, alive_cells(s, cut), true, s);
    for (int cell = 0; cell < CELLS; ++cell)
      if (s.length[cell]) backward_cell(cell, channels, cut, s);
    for (int k = 0; k < n; ++k) {
      T* slot = slots + (at - start + k) * stride;
      entry_geometry(k, s, slot);
      in_groups(channels, [&](int64_t c, auto size) {
        entry_features<T, decltype(size)::value>(k, s, s.image.get() + c * PIXELS,
                                                 slot + GEOMETRY + c);
      });
    }
  }
}

// Adds the slots of entries [from, to) to the Gaussians' sums and gradients, in tile order.
template <class T>
void reduce(const Job& job, const Plan<T>& plan, const T* slots, int64_t from, int64_t to,
            std::vector<int64_t>& cursor, double* sums) {
  const int64_t total = job.B * job.N, stride = GEOMETRY + job.C;
  T* d_features = static_cast<T*>(job.d_features);
#pragma omp parallel for schedule(static) num_threads(int(job.threads))
  for (int64_t i = 0; i < total; ++i) {
    for (; cursor[i] < plan.gaussian_start[i + 1]; ++cursor[i]) {
      const int64_t entry = plan.position[cursor[i]];
      if (entry >= to) break;
      const T* slot = slots + (entry - from) * stride;
      for (int k = 0; k < GEOMETRY; ++k) sums[GEOMETRY * i + k] += slot[k];
      for (int64_t c = 0; c < job.C; ++c) d_features[i * job.C + c] += slot[GEOMETRY + c];
    }
  }
}

// Gradients of mean, factors and opacity from the sums over a Gaussian's pixels, with
// dalpha/dq = -alpha / 2, q = (u^2 + v^2) / UNITS^2, u = p (dx + k dy) UNITS, v = r dy UNITS.
template <class T> void geometry_gradient(const Job& job, const Plan<T>& plan, const double* sums) {
  const Inputs<T> in(job);
#pragma omp parallel for schedule(static) num_threads(int(job.threads))
  for (int64_t i = 0; i < job.B * job.N; ++i) {
    if (plan.gaussian_start[i] == plan.gaussian_start[i + 1]) continue;
    const double *s = sums + GEOMETRY * i, *factor = in.factors + 3 * i;
    const double p = factor[0], k = factor[1], r = factor[2], o = in.opacities[i];
    const double once = o / UNITS, twice = o / (UNITS * UNITS);
    job.d_means[2 * i] = once * p * s[1];
    job.d_means[2 * i + 1] = once * (p * k * s[1] + r * s[2]);
    job.d_factors[3 * i] = -twice * s[3] / p;
    job.d_factors[3 * i + 1] = -twice * s[4] * p / r;
    job.d_factors[3 * i + 2] = -twice * s[5] / r;
    static_cast<T*>(job.d_opacities)[i] = T(s[0]);
  }
}

}  // namespace gsgan
