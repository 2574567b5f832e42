// Binning: the list of Gaussians that reach each tile, front to back.
#pragma once

#include <cstring>

#include "place.h"

namespace gsgan {

constexpr int BIN_BLOCK = 1024;  // Gaussians per binning task

struct Range {  // inclusive
  int64_t low, high;
  bool empty() const { return low > high; }
  int64_t size() const { return high - low + 1; }
};

// Pixels whose centre is within centre +- extent, enlarged by rounding (of an extent in T).
template <class T> Range pixels(double centre, double extent, int64_t size) {
  const double rounding = double(std::numeric_limits<T>::epsilon());
  const double pad = PAD + rounding * (std::abs(centre) + 4 * extent);
  const double low = std::max(0.0, std::ceil(centre - extent - 0.5 - pad));
  const double high = std::min(double(size - 1), std::floor(centre + extent - 0.5 + pad));
  if (!(low <= high)) return {0, -1};
  return {int64_t(low), int64_t(high)};
}

// The u^2 + v^2 beyond which alpha < alpha_min.
template <class T> T reach(T opacity, T alpha_min) {
  if (!(alpha_min > 0)) return std::numeric_limits<T>::infinity();
  return opacity > 0 ? std::log2(opacity / alpha_min) : -T(1);
}

// Increases with depth; -0 and 0 are equal.
inline uint64_t sort_key(double depth) {
  depth += 0.0;
  uint64_t u;
  std::memcpy(&u, &depth, 8);
  return u >> 63 ? ~u : u | (uint64_t(1) << 63);
}

// Stable radix sort of indices by key.
inline void sort_by_key(std::vector<uint64_t>& keys, std::vector<int32_t>& index, int bits) {
  constexpr int DIGIT = 11, BUCKETS = 1 << DIGIT;
  const size_t n = keys.size();
  std::vector<uint64_t> keys2(n);
  std::vector<int32_t> index2(n);
  for (int shift = 0; shift < bits; shift += DIGIT) {
    std::vector<size_t> start(BUCKETS + 1, 0);
    for (size_t i = 0; i < n; ++i) ++start[((keys[i] >> shift) & (BUCKETS - 1)) + 1];
    if (n == 0 || start[((keys[0] >> shift) & (BUCKETS - 1)) + 1] == n) continue;
    for (int k = 0; k < BUCKETS; ++k) start[k + 1] += start[k];
    for (size_t i = 0; i < n; ++i) {
      const size_t to = start[(keys[i] >> shift) & (BUCKETS - 1)]++;
      keys2[to] = keys[i];
      index2[to] = index[i];
    }
    keys.swap(keys2);
    index.swap(index2);
  }
}

template <class T> bool is_finite(const Inputs<T>& in, int64_t i) {
  const double geometry = in.means[2 * i] * 0 + in.means[2 * i + 1] * 0 + in.factors[3 * i] * 0 +
                          in.factors[3 * i + 1] * 0 + in.factors[3 * i + 2] * 0;
  return geometry == 0 && in.opacities[i] * 0 + in.depths[i] * 0 == 0 &&
         !std::isnan(in.extents[2 * i]) && !std::isnan(in.extents[2 * i + 1]);
}

// Prepares Gaussian i and appends the tiles that it can reach, row by row. Returns false when it is
// not finite.
template <class T>
bool reached_tiles(const Job& job, const Inputs<T>& in, int64_t i, const Plan<T>& plan,
                   Ellipse<T>& ellipse, std::vector<int32_t>& out) {
  if (!job.visible[i]) return true;
  if (!is_finite(in, i)) return false;
  const T o = in.opacities[i], ex = in.extents[2 * i], ey = in.extents[2 * i + 1];
  if (!(ex > 0 && ey > 0)) return true;
  const T level = reach(o, T(job.alpha_min));
  if (level < 0) return true;
  const double mx = in.means[2 * i], my = in.means[2 * i + 1];
  const Range px = pixels<T>(mx, ex, job.W), py = pixels<T>(my, ey, job.H);
  if (px.empty() || py.empty()) return true;
  const Range tx{px.low / TILE, px.high / TILE}, ty{py.low / TILE, py.high / TILE};
  const double *factor = in.factors + 3 * i, p = factor[0] * UNITS, r = factor[2] * UNITS;
  ellipse = {mx, my, factor[1], T(p), T(r), o, ex, ey, level};
  const int64_t first = i / job.N * plan.tiles_y * plan.tiles_x;
  // An ellipse crosses every tile of a single row or column of its bounding box.
  const bool test = tx.size() > 1 && ty.size() > 1 && std::isfinite(level);
  if (!test) {
    for (int64_t y = ty.low; y <= ty.high; ++y)
      for (int64_t x = tx.low; x <= tx.high; ++x)
        out.push_back(int32_t(first + y * plan.tiles_x + x));
    return true;
  }
  constexpr double HALF = 0.5 * (TILE - 1);
  const double middle_x = (tx.low + 0.5) * TILE, middle_y = (ty.low + 0.5) * TILE;
  const Least<double> least(place_at<double>(ellipse, middle_x, middle_y));
  const double far = TILE * double(std::max(tx.size(), ty.size()));
  // p, r and level are rounded to T, which only scales u and v.
  const double rounding = 8 * double(std::numeric_limits<T>::epsilon());
  const double bound = level * (1 + rounding) + rounding + least.margin(far);
  for (int64_t y = ty.low; y <= ty.high; ++y)
    for (int64_t x = tx.low; x <= tx.high; ++x) {
      const double cx = double((x - tx.low) * TILE), cy = double((y - ty.low) * TILE);
      if (least(cx - HALF, cx + HALF, cy - HALF, cy + HALF) <= bound)
        out.push_back(int32_t(first + y * plan.tiles_x + x));
    }
  return true;
}

// Tiles of each Gaussian, in blocks of Gaussians; fills ellipses and gaussian_start (counts).
template <class T>
Status find_tiles(Job& job, Plan<T>& plan, std::vector<std::vector<int32_t>>& found) {
  const Inputs<T> in(job);
  const int64_t total = job.B * job.N, blocks = int64_t(found.size());
  int64_t bad = -1;
  int failed = 0;
#pragma omp parallel for schedule(dynamic, 1) num_threads(int(job.threads)) if (blocks > 1) \
    reduction(max : bad) reduction(| : failed)
  for (int64_t block = 0; block < blocks; ++block) {
    try {
      const int64_t end = std::min(total, (block + 1) * BIN_BLOCK);
      for (int64_t i = block * BIN_BLOCK; i < end; ++i) {
        const size_t before = found[block].size();
        if (!reached_tiles(job, in, i, plan, plan.ellipses[i], found[block]))
          bad = std::max(bad, i);
        plan.gaussian_start[i + 1] = int64_t(found[block].size() - before);
      }
    } catch (const std::bad_alloc&) {  // an exception must not leave the parallel region
      failed = 1;
    }
  }
  if (failed) return OUT_OF_MEMORY;
  job.bad = bad;
  return bad >= 0 ? NOT_FINITE : OK;
}

// Converts the tiles found to lists, with each batch item's Gaussians in depth order.
template <class T> Status fill_lists(const Job& job, Plan<T>& plan) {
  const Inputs<T> in(job);
  std::vector<int64_t> cursor(plan.tile_start.begin(), plan.tile_start.end() - 1);
  int failed = 0;
#pragma omp parallel for schedule(dynamic, 1) num_threads(int(job.threads)) if (job.B > 1) \
    reduction(| : failed)
  for (int64_t b = 0; b < job.B; ++b) {
    try {
      std::vector<uint64_t> keys;
      std::vector<int32_t> order;
      keys.reserve(job.N);
      order.reserve(job.N);
      for (int64_t i = b * job.N; i < (b + 1) * job.N; ++i)
        if (plan.gaussian_start[i + 1] > plan.gaussian_start[i]) {
          keys.push_back(sort_key(in.depths[i]));
          order.push_back(int32_t(i));
        }
      sort_by_key(keys, order, 64);
      for (int32_t i : order)
        for (int64_t k = plan.gaussian_start[i]; k < plan.gaussian_start[i + 1]; ++k) {
          const int64_t to = cursor[plan.position[k]]++;
          plan.entries[to] = i;
          plan.position[k] = uint32_t(to);
        }
    } catch (const std::bad_alloc&) {
      failed = 1;
    }
  }
  return failed ? OUT_OF_MEMORY : OK;
}

template <class T> Status bin(Job& job, Plan<T>& plan) {
  plan.tiles_x = (job.W + TILE - 1) / TILE;
  plan.tiles_y = (job.H + TILE - 1) / TILE;
  plan.tiles = job.B * plan.tiles_x * plan.tiles_y;
  const int64_t total = job.B * job.N;
  if (total >= INT32_MAX || plan.tiles >= INT32_MAX) return TOO_MANY;
  plan.ellipses.resize(total);
  plan.gaussian_start.assign(total + 1, 0);
  std::vector<std::vector<int32_t>> found((total + BIN_BLOCK - 1) / BIN_BLOCK);
  if (const Status status = find_tiles(job, plan, found)) return status;
  for (int64_t i = 0; i < total; ++i) plan.gaussian_start[i + 1] += plan.gaussian_start[i];
  const int64_t count = plan.gaussian_start[total];
  if (count >= int64_t(UINT32_MAX)) return TOO_MANY;

  plan.position.resize(count);
  plan.tile_start.assign(plan.tiles + 1, 0);
  int64_t at = 0;
  for (auto& tiles : found) {
    for (int32_t tile : tiles) {
      plan.position[at++] = uint32_t(tile);  // replaced by the entry in fill_lists
      ++plan.tile_start[tile + 1];
    }
    std::vector<int32_t>().swap(tiles);
  }
  for (int64_t t = 0; t < plan.tiles; ++t) plan.tile_start[t + 1] += plan.tile_start[t];
  plan.entries.resize(count);
  if (const Status status = fill_lists(job, plan)) return status;

  plan.chunk_start.assign(plan.tiles + 1, 0);
  plan.chunks_done.assign(plan.tiles, 0);
  for (int64_t t = 0; t < plan.tiles; ++t)
    plan.chunk_start[t + 1] = plan.chunk_start[t] +
                              (plan.tile_start[t + 1] - plan.tile_start[t] + CHUNK - 1) / CHUNK;
  if (job.keep) {
    plan.cells.resize(count);
    plan.checkpoints.resize(plan.chunk_start[plan.tiles] * PIXELS);
  }
  return OK;
}

}  // namespace gsgan
