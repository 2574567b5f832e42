// A tile's working memory: its pixels and the current chunk of its list; and the contribution of a
// Gaussian to one register of pixels.
#pragma once

#include <cstring>

#include "place.h"
#include "simd.h"

namespace gsgan {

constexpr int GROUP = 8;     // channels per register block
constexpr int GEOMETRY = 6;  // sums per entry before the features', see entry_geometry
template <class T> constexpr int SUBS = LANES / Simd<T>::W;  // registers per cell

// One thread's working memory.
template <class T> struct Scratch {
  Scratch(int64_t channels, bool backward)
      : features(CHUNK * channels),
        image(channels * PIXELS),
        weights(CHUNK * LANES),
        transmittance(PIXELS) {
    if (!backward) return;
    for (Buffer<T>* b : {&behind, &alpha_grad}) b->resize(PIXELS);
    for (Buffer<T>* b : {&e, &alpha, &v}) b->resize(CHUNK * LANES);
    for (Buffer<T>* b : {&record_w, &record_g}) b->resize(CHUNK * CELLS * LANES);
  }
  Place<T> place[CHUNK];             // from the tile's centre
  T opacity[CHUNK], ex[CHUNK], ey[CHUNK];
  uint32_t mask[CHUNK];              // cells reached, one bit each
  int32_t first[CHUNK + 1];          // record of an entry's first cell
  int32_t list[CELLS][CHUNK];        // entries of a cell
  int32_t record[CELLS][CHUNK];      // and their records
  int32_t length[CELLS];
  Buffer<T> features;                // [CHUNK, channels]
  Buffer<T> image;                   // [channels, PIXELS]: the image, or its gradient
  Buffer<T> weights, transmittance;  // [CHUNK, W], [PIXELS]
  Buffer<T> behind, alpha_grad;      // [PIXELS]
  Buffer<T> e, alpha, v;             // [CHUNK, W]
  Buffer<T> record_w, record_g;      // [records, LANES]: alpha T, and dL/dalpha exp(-q/2)
};

struct Tile {
  int64_t b, x, y;  // batch item; column and row of the first pixel
  int64_t width, height;
};

template <class T> Tile tile_at(const Job& job, const Plan<T>& plan, int64_t index) {
  const int64_t in_image = index % (plan.tiles_x * plan.tiles_y);
  Tile t;
  t.b = index / (plan.tiles_x * plan.tiles_y);
  t.x = in_image % plan.tiles_x * TILE;
  t.y = in_image / plan.tiles_x * TILE;
  t.width = std::min<int64_t>(TILE, job.W - t.x);
  t.height = std::min<int64_t>(TILE, job.H - t.y);
  return t;
}

INLINE int pixel_of(int x, int y) {  // cell by cell
  return ((y / CELL) * (TILE / CELL) + x / CELL) * LANES + (y % CELL) * CELL + x % CELL;
}

// Copies between a plane [H, W] of the image and a tile; pixels outside the image are 0.
template <class T> void read_plane(const T* plane, int64_t stride, const Tile& t, T* to) {
  if (t.width < TILE || t.height < TILE) std::fill_n(to, PIXELS, T(0));
  for (int y = 0; y < t.height; ++y) {
    const T* row = plane + (t.y + y) * stride + t.x;
    if (t.width == TILE)
      for (int x = 0; x < TILE; x += CELL)
        std::memcpy(to + pixel_of(x, y), row + x, CELL * sizeof(T));
    else
      for (int x = 0; x < t.width; ++x) to[pixel_of(x, y)] = row[x];
  }
}

template <class T> void write_plane(T* plane, int64_t stride, const Tile& t, const T* from) {
  for (int y = 0; y < t.height; ++y) {
    T* row = plane + (t.y + y) * stride + t.x;
    if (t.width == TILE)
      for (int x = 0; x < TILE; x += CELL)
        std::memcpy(row + x, from + pixel_of(x, y), CELL * sizeof(T));
    else
      for (int x = 0; x < t.width; ++x) row[x] = from[pixel_of(x, y)];
  }
}

// The same for `channels` planes whose channels are adjacent in the image.
template <class T>
void read_pixels(const T* image, int64_t stride, int64_t channels, const Tile& t, T* to) {
  if (t.width < TILE || t.height < TILE) std::fill_n(to, channels * PIXELS, T(0));
  for (int y = 0; y < t.height; ++y)
    for (int x = 0; x < t.width; ++x) {
      const T* pixel = image + ((t.y + y) * stride + t.x + x) * channels;
      T* at = to + pixel_of(x, y);
      for (int64_t c = 0; c < channels; ++c) at[c * PIXELS] = pixel[c];
    }
}

template <class T>
void write_pixels(T* image, int64_t stride, int64_t channels, const Tile& t, const T* from) {
  for (int y = 0; y < t.height; ++y)
    for (int x = 0; x < t.width; ++x) {
      T* pixel = image + ((t.y + y) * stride + t.x + x) * channels;
      const T* at = from + pixel_of(x, y);
      for (int64_t c = 0; c < channels; ++c) pixel[c] = at[c * PIXELS];
    }
}

// Adds the gradient of a plane's averages over times x times pixels to that of its pixels.
template <class T>
void add_spread(const T* plane, int64_t stride, int64_t times, const Tile& t, T* to) {
  const T share = T(1) / T(times * times);
  for (int y = 0; y < t.height; ++y) {
    const T* row = plane + (t.y + y) / times * (stride / times) + t.x / times;
    for (int x = 0; x < t.width; ++x) to[pixel_of(x, y)] += share * row[x / times];
  }
}

template <class T>
void write_average(T* plane, int64_t stride, int64_t times, const Tile& t, const T* from) {
  const T share = T(1) / T(times * times);
  for (int y = 0; y < t.height; y += times) {
    T* row = plane + (t.y + y) / times * (stride / times) + t.x / times;
    for (int x = 0; x < t.width; x += times) {
      T sum = 0;
      for (int i = 0; i < times; ++i)
        for (int j = 0; j < times; ++j) sum += from[pixel_of(x + j, y + i)];
      row[x / times] = share * sum;
    }
  }
}

// Which cells of its tile the ellipse {alpha >= alpha_min} and the extent can reach.
template <class T> INLINE uint32_t reached_cells(const Place<T>& at, T ex, T ey, T level) {
  constexpr T HALF = T(0.5) * (TILE - 1);
  const Least<T> least(at);
  const T bound = level + least.margin(HALF);
  const T slack = T(PAD) + 8 * std::numeric_limits<T>::epsilon() *
                                (std::abs(at.dx) + std::abs(at.dy) + TILE);
  ex += slack;
  ey += slack;
  uint32_t mask = 0;
#pragma omp simd reduction(| : mask)
  for (int cell = 0; cell < CELLS; ++cell) {
    const T x0 = T(cell % 4 * CELL) - HALF, y0 = T(cell / 4 * CELL) - HALF;
    const T x1 = x0 + (CELL - 1), y1 = y0 + (CELL - 1);
    const uint32_t out = uint32_t(least(x0, x1, y0, y1) > bound) | uint32_t(x0 + at.dx > ex) |
                         uint32_t(x1 + at.dx < -ex) | uint32_t(y0 + at.dy > ey) |
                         uint32_t(y1 + at.dy < -ey);
    mask |= (out ^ 1u) << cell;
  }
  return mask;
}

// Gathers entries [start, start + n) of a tile and sorts them into its alive cells. A record is an
// (entry, cell) pair; those of an entry are adjacent.
template <class T>
void load_chunk(const Job& job, const Inputs<T>& in, const Plan<T>& plan, const Tile& tile,
                int64_t start, int n, int64_t channels, uint32_t alive, bool again,
                Scratch<T>& s) {
  constexpr int AHEAD = 8;
  const double middle_x = double(tile.x) + 0.5 * TILE, middle_y = double(tile.y) + 0.5 * TILE;
  for (int cell = 0; cell < CELLS; ++cell) s.length[cell] = 0;
  int records = 0;
  for (int k = 0; k < n; ++k) {
    const int64_t i = plan.entries[start + k];
    const Ellipse<T>& g = plan.ellipses[i];
    if (k + AHEAD < n) __builtin_prefetch(&plan.ellipses[plan.entries[start + k + AHEAD]]);
    s.place[k] = place_at<T>(g, middle_x, middle_y);
    s.opacity[k] = g.opacity;
    s.ex[k] = g.ex;
    s.ey[k] = g.ey;
    T* f = s.features.get() + k * channels;
    for (int64_t j = 0; j < channels; ++j) f[j] = in.features[i * channels + j];
    uint32_t mask = again ? plan.cells[start + k]
                          : reached_cells(s.place[k], g.ex, g.ey, g.level);
    if (job.keep) plan.cells[start + k] = uint16_t(mask);
    mask &= alive;
    s.mask[k] = mask;
    s.first[k] = records;
    while (mask) {
      const int cell = __builtin_ctz(mask);
      mask &= mask - 1;
      const int at = s.length[cell]++;
      s.list[cell][at] = k;
      s.record[cell][at] = records++;
    }
  }
  s.first[n] = records;
}

template <class T> struct Pixels {  // one register of pixel centres, relative to the tile's centre
  Vec<T> x, y;
};

template <class T> INLINE Pixels<T> pixels_of(int cell, int sub) {
  constexpr int W = Simd<T>::W;
  alignas(64) static constexpr T X[LANES] = {-7.5, -6.5, -5.5, -4.5, -7.5, -6.5, -5.5, -4.5,
                                             -7.5, -6.5, -5.5, -4.5, -7.5, -6.5, -5.5, -4.5};
  alignas(64) static constexpr T Y[LANES] = {-7.5, -7.5, -7.5, -7.5, -6.5, -6.5, -6.5, -6.5,
                                             -5.5, -5.5, -5.5, -5.5, -4.5, -4.5, -4.5, -4.5};
  return {load(X + sub * W) + T(cell % 4 * CELL), load(Y + sub * W) + T(cell / 4 * CELL)};
}

template <class T> struct Cutoffs {
  explicit Cutoffs(const Job& job)
      : alpha_min(T(job.alpha_min)),
        transmittance_min(T(job.transmittance_min)),
        alpha_max(T(job.alpha_max)),
        box(job.box != 0) {}
  T alpha_min, transmittance_min, alpha_max;
  bool box;
};

template <class T> struct Whitened {
  Vec<T> u, v;
};

template <class T> INLINE Whitened<T> whitened(const Place<T>& g, const Pixels<T>& p) {
  return {g.p * p.x + (g.w * p.y + g.u), g.r * p.y + g.v};
}

template <class T> struct Hit {
  Vec<T> e, alpha;  // exp(-q/2) where a gradient passes, else 0; min(alpha_max, o e), 0 if skipped
};

template <class T>
INLINE Hit<T> hit(const Scratch<T>& s, int k, const Pixels<T>& p, Vec<T> transmittance,
                  const Cutoffs<T>& cut) {
  using V = Vec<T>;
  const V zero = splat<T>(0), cap = splat<T>(cut.alpha_max);
  const Whitened<T> at = whitened(s.place[k], p);
  V e = exp2_of_negative<T>(-(at.u * at.u + at.v * at.v));
  const V raw = e * s.opacity[k];
  e = raw >= splat<T>(cut.alpha_min) ? e : zero;
  e = transmittance >= splat<T>(cut.transmittance_min) ? e : zero;
  if (cut.box) {
    e = magnitude(p.x + s.place[k].dx) <= splat<T>(s.ex[k]) ? e : zero;
    e = magnitude(p.y + s.place[k].dy) <= splat<T>(s.ey[k]) ? e : zero;
  }
  const V alpha = e * s.opacity[k];
  return {raw > cap ? zero : e, alpha < cap ? alpha : cap};
}

// Calls f with the number of channels in each group as a constant: 8, 8, ..., remainder.
template <class F> INLINE void in_groups(int64_t channels, F&& f) {
  int64_t c = 0;
  for (; c + GROUP <= channels; c += GROUP) f(c, std::integral_constant<int, GROUP>());
  switch (channels - c) {
    case 1: f(c, std::integral_constant<int, 1>()); break;
    case 2: f(c, std::integral_constant<int, 2>()); break;
    case 3: f(c, std::integral_constant<int, 3>()); break;
    case 4: f(c, std::integral_constant<int, 4>()); break;
    case 5: f(c, std::integral_constant<int, 5>()); break;
    case 6: f(c, std::integral_constant<int, 6>()); break;
    case 7: f(c, std::integral_constant<int, 7>()); break;
    default: break;
  }
}

}  // namespace gsgan
