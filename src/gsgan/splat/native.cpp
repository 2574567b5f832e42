// Compositing of projected Gaussians on the CPU: forward and hand-written backward.
//
// Compiled on first use by native.py and called through ctypes; needs a C++17 compiler with vector
// extensions (gcc, clang), nothing of torch. Contract and definitions: see native.py.
//
// How it works
//   bin        Gaussians are put, in depth order, into lists of 16 x 16 pixel tiles.
//   tile       a list is walked in chunks; a tile has 16 cells of 4 x 4 pixels, and each cell gets
//              the sub-list of the Gaussians that can reach it. A cell is 16 pixels: one AVX-512
//              register of floats, two of AVX, four of SSE or NEON.
//   forward    per cell: front to back, transmittance in a register; the weights of a chunk are
//              kept, then multiplied into the channels in groups of up to 8.
//   backward   chunks from back to front; the transmittance before each chunk was stored by the
//              forward pass, so nothing is recovered by division: alpha = 1 and a transmittance
//              of 0 have exact gradients. With R the colour behind i seen through nothing else,
//                  dL/dalpha_i = T_i (v_i - R_i),   R_{i-1} = alpha_i v_i + (1 - alpha_i) R_i.
//   reduce     gradients are written per (tile, Gaussian) and added in a fixed order: the result
//              does not depend on threads.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <memory>
#include <new>
#include <type_traits>
#include <utility>
#include <vector>

#ifdef _OPENMP
#include <omp.h>
#endif

#if defined(__AVX512F__)
#define SIMD_BYTES 64
#elif defined(__AVX__)
#define SIMD_BYTES 32
#else
#define SIMD_BYTES 16
#endif
#define INLINE inline __attribute__((always_inline))

namespace {

constexpr int TILE = 16;             // pixels; 8 and 32 were slower
constexpr int CELL = 4;              // pixels
constexpr int CELLS = 16;            // per tile
constexpr int LANES = CELL * CELL;   // pixels per cell
constexpr int PIXELS = TILE * TILE;  // per tile, stored cell by cell
constexpr int CHUNK = 64;            // entries of a tile's list that are worked on at a time
constexpr int GROUP = 8;             // channels per register block
constexpr int GEOMETRY = 6;          // gradients per entry before the features: mean 2, conic 3, o
constexpr int BIN_BLOCK = 1024;      // Gaussians per binning task

// ---------------------------------------------------------------------------------------- vectors

template <class T> struct Simd;
template <> struct Simd<float> {
  typedef float V __attribute__((vector_size(SIMD_BYTES)));
  typedef int32_t I __attribute__((vector_size(SIMD_BYTES)));
  static constexpr int W = SIMD_BYTES / 4;
};
template <> struct Simd<double> {
  typedef double V __attribute__((vector_size(SIMD_BYTES)));
  typedef int64_t I __attribute__((vector_size(SIMD_BYTES)));
  static constexpr int W = SIMD_BYTES / 8;
};

template <class T> using Vec = typename Simd<T>::V;
template <class T> constexpr int SUBS = LANES / Simd<T>::W;  // registers per cell

template <class T> INLINE Vec<T> load(const T* p) { return *reinterpret_cast<const Vec<T>*>(p); }
template <class T> INLINE void store(T* p, Vec<T> v) { *reinterpret_cast<Vec<T>*>(p) = v; }
template <class T> INLINE Vec<T> splat(T x) { return Vec<T>{} + x; }

// The register's lanes, turned by K.
#if defined(__clang__) || __GNUC__ >= 12
template <class T, int K, int... L>
INLINE Vec<T> turned(Vec<T> v, std::integer_sequence<int, L...>) {
  return __builtin_shufflevector(v, v, ((L + K) % int(sizeof...(L)))...);
}
#else
template <class T, int K, int... L>
INLINE Vec<T> turned(Vec<T> v, std::integer_sequence<int, L...>) {
  return __builtin_shuffle(v, typename Simd<T>::I{((L + K) % int(sizeof...(L)))...});
}
#endif

template <class T, int K = Simd<T>::W / 2> INLINE T sum(Vec<T> v) {
  if constexpr (K == 0)
    return v[0];
  else
    return sum<T, K / 2>(v + turned<T, K>(v, std::make_integer_sequence<int, Simd<T>::W>()));
}

template <class T> INLINE bool any_at_least(Vec<T> v, T bound) {
  constexpr int W = Simd<T>::W;
  alignas(64) T t[W];
  store(t, v);
  int found = 0;
  for (int i = 0; i < W; ++i) found |= t[i] >= bound;
  return found != 0;
}

// exp(x) = 2^n exp(r), |r| <= ln2 / 2, by its Taylor series: within 2 ulp for x in [LOW, HIGH].
// Below LOW it is 0 (a weight under 2e-38, or 1e-307 in double).
template <class T> struct Exp;
template <> struct Exp<float> {
  static constexpr float LOW = -87.0f, HIGH = 88.0f, MAGIC = 12582912.0f;  // 1.5 * 2^23
  static constexpr float LN2_HIGH = 0.693359375f, LN2_LOW = -2.12194440e-4f;
  static constexpr int TERMS = 7, MANTISSA = 23;
};
template <> struct Exp<double> {
  static constexpr double LOW = -708.0, HIGH = 709.0, MAGIC = 6755399441055744.0;  // 1.5 * 2^52
  static constexpr double LN2_HIGH = 0.693145751953125, LN2_LOW = 1.42860682030941723212e-6;
  static constexpr int TERMS = 13, MANTISSA = 52;
};

constexpr double INVERSE_FACTORIAL[] = {1.0,
                                        1.0,
                                        1.0 / 2,
                                        1.0 / 6,
                                        1.0 / 24,
                                        1.0 / 120,
                                        1.0 / 720,
                                        1.0 / 5040,
                                        1.0 / 40320,
                                        1.0 / 362880,
                                        1.0 / 3628800,
                                        1.0 / 39916800,
                                        1.0 / 479001600,
                                        1.0 / 6227020800.0};

template <class T> INLINE Vec<T> exponential(Vec<T> x) {
  using E = Exp<T>;
  using V = Vec<T>;
  using I = typename Simd<T>::I;
  const V low = splat<T>(E::LOW), high = splat<T>(E::HIGH), zero = splat<T>(0);
  V y = x < low ? low : x;
  y = y > high ? high : y;
  const V shifted = y * T(1.4426950408889634) + E::MAGIC;  // the integer n sits in the low bits
  const V n = shifted - E::MAGIC;
  const V r = (y - n * E::LN2_HIGH) - n * E::LN2_LOW;
  V p = splat<T>(T(INVERSE_FACTORIAL[E::TERMS]));
#pragma GCC unroll 16
  for (int k = E::TERMS - 1; k >= 0; --k) p = p * r + T(INVERSE_FACTORIAL[k]);
  const V scaled = reinterpret_cast<V>(reinterpret_cast<I>(p) +
                                       (reinterpret_cast<I>(shifted) << E::MANTISSA));
  return x < low ? zero : scaled;
}

// ------------------------------------------------------------------------------------------ memory

template <class T> class Buffer {  // 64-byte aligned, uninitialised
 public:
  Buffer() = default;
  explicit Buffer(size_t n) { resize(n); }
  void resize(size_t n) {
    void* p = nullptr;
    if (posix_memalign(&p, 64, std::max<size_t>(n, 1) * sizeof(T)) != 0) throw std::bad_alloc();
    data_.reset(static_cast<T*>(p));
  }
  T* get() const { return data_.get(); }
  T& operator[](size_t i) const { return data_.get()[i]; }

 private:
  struct Free {
    void operator()(T* p) const { std::free(p); }
  };
  std::unique_ptr<T, Free> data_;
};

}  // namespace

extern "C" {

// Mirrors native.py's _Job field by field. Arrays are contiguous; null where not wanted.
struct Job {
  int64_t B, N, C, H, W;
  int64_t threads;
  int64_t keep;        // whether a backward pass will follow
  int64_t slot_bytes;  // of per-entry gradients that the backward pass may hold at once
  double alpha_min, transmittance_min, alpha_max;
  const void *means, *conics, *opacities, *features, *depths, *extents;
  const uint8_t* visible;
  void *out_features, *out_alpha, *out_depth;
  const void *g_features, *g_alpha, *g_depth;
  void *d_means, *d_conics, *d_opacities, *d_features, *d_depths;
  int64_t bad;  // out: index of a Gaussian that is not finite
};

enum Status { OK = 0, OUT_OF_MEMORY = 1, NOT_FINITE = 2, TOO_MANY = 3 };
}

namespace {

// ----------------------------------------------------------------------------------------- binning

// A Gaussian, ready for the tiles: one cache line.
template <class T> struct alignas(16 * sizeof(T)) Ellipse {
  T mx, my;
  T a, b, c;  // of -q / 2 = a dx^2 + b dx dy + c dy^2
  T opacity, ex, ey;
  T q_max;             // beyond it alpha < alpha_min
  T slope_x, slope_y;  // b / a and b / c of q
};

// What the backward pass needs of the forward pass, beside its inputs.
template <class T> struct Plan {
  int64_t tiles_x = 0, tiles_y = 0, tiles = 0;  // tiles: of all batch items
  std::vector<int64_t> tile_start;              // [tiles + 1] into entries
  std::vector<int64_t> gaussian_start;          // [B N + 1] into position
  Buffer<Ellipse<T>> ellipses;  // [B N]; of Gaussians without entries: undefined
  Buffer<int32_t> entries;    // Gaussian (b N + n) of each entry: tile by tile, front to back
  Buffer<uint16_t> cells;     // cells of its tile that each entry reaches, one bit each
  Buffer<uint32_t> position;  // entry of each (Gaussian, tile): Gaussian by Gaussian
  std::vector<int64_t> chunk_start;  // [tiles + 1] into checkpoints
  std::vector<int32_t> chunks_done;  // [tiles] chunks walked before every pixel had stopped
  Buffer<T> checkpoints;             // [chunks, PIXELS] transmittance before each chunk
};

template <class T> struct Inputs {
  explicit Inputs(const Job& j)
      : means(static_cast<const T*>(j.means)),
        conics(static_cast<const T*>(j.conics)),
        opacities(static_cast<const T*>(j.opacities)),
        features(static_cast<const T*>(j.features)),
        depths(static_cast<const T*>(j.depths)),
        extents(static_cast<const T*>(j.extents)) {}
  const T *means, *conics, *opacities, *features, *depths, *extents;
};

struct Range {  // inclusive
  int64_t low, high;
  bool empty() const { return low > high; }
  int64_t size() const { return high - low + 1; }
};

// Pixels whose centre lies within centre +- extent, widened by rounding.
template <class T> Range pixels(T centre, T extent, int64_t size) {
  const double c = centre, e = extent;
  const double pad = 1e-3 + 4 * double(std::numeric_limits<T>::epsilon()) * (std::abs(c) + e);
  const double low = std::max(0.0, std::ceil(c - e - 0.5 - pad));
  const double high = std::min(double(size - 1), std::floor(c + e - 0.5 + pad));
  if (!(low <= high)) return {0, -1};
  return {int64_t(low), int64_t(high)};
}

// The q = a dx^2 + 2 b dx dy + c dy^2 beyond which alpha < alpha_min.
template <class T> T reach(T opacity, T alpha_min) {
  if (!(alpha_min > 0)) return std::numeric_limits<T>::infinity();
  return opacity > 0 ? 2 * std::log(opacity / alpha_min) : -T(1);
}

// Least q over a rectangle given relative to the mean, less the rounding error of q itself. The
// minimum of a convex q lies on an edge that faces the mean; slope_x = b / a, slope_y = b / c.
template <class T>
INLINE T least_q(T a, T b, T c, T slope_x, T slope_y, T x0, T x1, T y0, T y1) {
  const T x_near = x0 > 0 ? x0 : (x1 < 0 ? x1 : T(0));
  const T y_near = y0 > 0 ? y0 : (y1 < 0 ? y1 : T(0));
  T y = -slope_y * x_near;
  y = y < y0 ? y0 : y;
  y = y > y1 ? y1 : y;
  T x = -slope_x * y_near;
  x = x < x0 ? x0 : x;
  x = x > x1 ? x1 : x;
  const T margin = 16 * std::numeric_limits<T>::epsilon();
  const T qa = a * x_near * x_near + c * y * y, qb = a * x * x + c * y_near * y_near;
  const T la = qa + 2 * b * x_near * y - margin * qa;
  const T lb = qb + 2 * b * x * y_near - margin * qb;
  return la < lb ? la : lb;
}

template <class T> uint64_t sort_key(T depth);
template <> uint64_t sort_key<float>(float depth) {
  depth += 0.0f;  // -0 and 0 are one depth
  uint32_t u;
  std::memcpy(&u, &depth, 4);
  return u & 0x80000000u ? uint32_t(~u) : u | 0x80000000u;
}
template <> uint64_t sort_key<double>(double depth) {
  depth += 0.0;
  uint64_t u;
  std::memcpy(&u, &depth, 8);
  return u >> 63 ? ~u : u | (uint64_t(1) << 63);
}

// Stable radix sort of indices by key.
void sort_by_key(std::vector<uint64_t>& keys, std::vector<int32_t>& index, int bits) {
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

// Prepares Gaussian g of batch item b and appends the tiles it can reach, row by row. False: it is
// not finite.
template <class T>
bool reached_tiles(const Job& job, const Inputs<T>& in, int64_t b, int64_t g, T alpha_min,
                   int64_t tiles_x, int64_t tiles_y, Ellipse<T>& ellipse,
                   std::vector<int32_t>& out) {
  const int64_t i = b * job.N + g;
  if (!job.visible[i]) return true;
  const T mx = in.means[2 * i], my = in.means[2 * i + 1];
  const T a = in.conics[3 * i], bb = in.conics[3 * i + 1], c = in.conics[3 * i + 2];
  const T o = in.opacities[i], ex = in.extents[2 * i], ey = in.extents[2 * i + 1];
  if (!std::isfinite(mx) || !std::isfinite(my) || !std::isfinite(a) || !std::isfinite(bb) ||
      !std::isfinite(c) || !std::isfinite(o) || !std::isfinite(in.depths[i]) || std::isnan(ex) ||
      std::isnan(ey))
    return false;
  if (!(ex > 0 && ey > 0)) return true;
  const T q_max = reach(o, alpha_min);
  if (q_max < 0) return true;
  const Range px = pixels(mx, ex, job.W), py = pixels(my, ey, job.H);
  if (px.empty() || py.empty()) return true;
  const Range tx{px.low / TILE, px.high / TILE}, ty{py.low / TILE, py.high / TILE};
  // An ellipse crosses every tile of a single row or column of its bounding box.
  const bool test = tx.size() > 1 && ty.size() > 1 && std::isfinite(q_max);
  const T slope_x = bb / a, slope_y = bb / c;
  ellipse = {mx, my, T(-0.5) * a, -bb, T(-0.5) * c, o, ex, ey, q_max, slope_x, slope_y};
  for (int64_t y = ty.low; y <= ty.high; ++y)
    for (int64_t x = tx.low; x <= tx.high; ++x) {
      if (test) {
        const T x0 = T(x * TILE + 0.5) - mx, y0 = T(y * TILE + 0.5) - my;
        if (least_q(a, bb, c, slope_x, slope_y, x0, x0 + (TILE - 1), y0, y0 + (TILE - 1)) > q_max)
          continue;
      }
      out.push_back(int32_t((b * tiles_y + y) * tiles_x + x));
    }
  return true;
}

template <class T> Status bin(Job& job, Plan<T>& plan) {
  const Inputs<T> in(job);
  const T alpha_min = T(job.alpha_min);
  plan.tiles_x = (job.W + TILE - 1) / TILE;
  plan.tiles_y = (job.H + TILE - 1) / TILE;
  plan.tiles = job.B * plan.tiles_x * plan.tiles_y;
  const int64_t total = job.B * job.N;
  if (total >= INT32_MAX || plan.tiles >= INT32_MAX) return TOO_MANY;

  // Tiles of each Gaussian, in blocks of Gaussians.
  const int64_t blocks = (total + BIN_BLOCK - 1) / BIN_BLOCK;
  std::vector<std::vector<int32_t>> found(blocks);
  plan.ellipses.resize(total);
  plan.gaussian_start.assign(total + 1, 0);
  int64_t bad = -1;
  int failed = 0;
#pragma omp parallel for schedule(dynamic, 1) num_threads(int(job.threads)) if (blocks > 1) \
    reduction(max : bad) reduction(| : failed)
  for (int64_t block = 0; block < blocks; ++block) {
    try {
      const int64_t end = std::min(total, (block + 1) * BIN_BLOCK);
      for (int64_t i = block * BIN_BLOCK; i < end; ++i) {
        const size_t before = found[block].size();
        if (!reached_tiles(job, in, i / job.N, i % job.N, alpha_min, plan.tiles_x, plan.tiles_y,
                           plan.ellipses[i], found[block]))
          bad = std::max(bad, i);
        plan.gaussian_start[i + 1] = int64_t(found[block].size() - before);
      }
    } catch (const std::bad_alloc&) {  // an exception must not leave the parallel region
      failed = 1;
    }
  }
  if (failed) return OUT_OF_MEMORY;
  if (bad >= 0) {
    job.bad = bad;
    return NOT_FINITE;
  }
  for (int64_t i = 0; i < total; ++i) plan.gaussian_start[i + 1] += plan.gaussian_start[i];
  const int64_t count = plan.gaussian_start[total];
  if (count >= int64_t(UINT32_MAX)) return TOO_MANY;

  plan.position.resize(count);
  plan.tile_start.assign(plan.tiles + 1, 0);
  int64_t at = 0;
  for (auto& tiles : found) {
    for (int32_t tile : tiles) {
      plan.position[at++] = uint32_t(tile);  // replaced by the entry below
      ++plan.tile_start[tile + 1];
    }
    std::vector<int32_t>().swap(tiles);
  }
  for (int64_t t = 0; t < plan.tiles; ++t) plan.tile_start[t + 1] += plan.tile_start[t];

  // Entries, front to back.
  plan.entries.resize(count);
  if (job.keep) plan.cells.resize(count);
  std::vector<int64_t> cursor(plan.tile_start.begin(), plan.tile_start.end() - 1);
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
          keys.push_back(sort_key<T>(in.depths[i]));
          order.push_back(int32_t(i));
        }
      sort_by_key(keys, order, int(sizeof(T)) * 8);
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
  if (failed) return OUT_OF_MEMORY;

  plan.chunk_start.assign(plan.tiles + 1, 0);
  plan.chunks_done.assign(plan.tiles, 0);
  for (int64_t t = 0; t < plan.tiles; ++t)
    plan.chunk_start[t + 1] = plan.chunk_start[t] +
                              (plan.tile_start[t + 1] - plan.tile_start[t] + CHUNK - 1) / CHUNK;
  if (job.keep) plan.checkpoints.resize(plan.chunk_start[plan.tiles] * PIXELS);
  return OK;
}

// ------------------------------------------------------------------------------------ tiles, cells

// One thread's working memory; channels: C, and the depth when it is wanted.
template <class T> struct Scratch {
  explicit Scratch(int64_t channels, bool backward)
      : features(CHUNK * channels),
        image(channels * PIXELS),
        weights(CHUNK * LANES),
        transmittance(PIXELS) {
    if (!backward) return;
    for (Buffer<T>* b : {&behind, &alpha_grad}) b->resize(PIXELS);
    for (Buffer<T>* b : {&e, &alpha, &before, &v}) b->resize(CHUNK * LANES);
    for (Buffer<T>* b : {&record_w, &record_g}) b->resize(CHUNK * CELLS * LANES);
  }
  Ellipse<T> entry[CHUNK];
  uint32_t mask[CHUNK];              // cells reached, one bit each
  int32_t first[CHUNK + 1];          // record of an entry's first cell
  int32_t list[CELLS][CHUNK];        // entries of a cell
  int32_t record[CELLS][CHUNK];      // and their records
  int32_t length[CELLS];
  Buffer<T> features;                // [CHUNK, channels]
  Buffer<T> image;                   // [channels, PIXELS]: the picture, or its gradient
  Buffer<T> weights, transmittance;  // [CHUNK, W], [PIXELS]
  Buffer<T> behind, alpha_grad;      // [PIXELS]
  Buffer<T> e, alpha, before, v;     // [CHUNK, W]
  Buffer<T> record_w, record_g;      // [records, LANES]: alpha T, and dL/dalpha exp(-q/2)
};

template <class T> struct Tile {
  int64_t b, x, y;  // batch item; column and row of the first pixel
  int64_t width, height;
};

template <class T> Tile<T> tile_at(const Job& job, const Plan<T>& plan, int64_t index) {
  const int64_t in_image = index % (plan.tiles_x * plan.tiles_y);
  Tile<T> t;
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

// Copies between a plane of the picture [H, W] and a tile; what lies outside the picture is 0.
template <class T> void read_plane(const T* plane, int64_t stride, const Tile<T>& t, T* to) {
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

template <class T> void write_plane(T* plane, int64_t stride, const Tile<T>& t, const T* from) {
  for (int y = 0; y < t.height; ++y) {
    T* row = plane + (t.y + y) * stride + t.x;
    if (t.width == TILE)
      for (int x = 0; x < TILE; x += CELL)
        std::memcpy(row + x, from + pixel_of(x, y), CELL * sizeof(T));
    else
      for (int x = 0; x < t.width; ++x) row[x] = from[pixel_of(x, y)];
  }
}

// Which cells of the tile at (left, top) the ellipse {alpha >= alpha_min} and the extent can reach.
template <class T> INLINE uint32_t reached_cells(const Ellipse<T>& g, T left, T top) {
  left -= g.mx;
  top -= g.my;
  const T slack = T(1e-3) + 8 * std::numeric_limits<T>::epsilon() *
                                (std::abs(left) + std::abs(top) + TILE);
  const T ex = g.ex + slack, ey = g.ey + slack;
  uint32_t mask = 0;
#pragma omp simd reduction(| : mask)
  for (int cell = 0; cell < CELLS; ++cell) {
    const T x0 = left + T(cell % 4 * CELL), y0 = top + T(cell / 4 * CELL);
    const T x1 = x0 + (CELL - 1), y1 = y0 + (CELL - 1);
    const T q = least_q(-2 * g.a, -g.b, -2 * g.c, g.slope_x, g.slope_y, x0, x1, y0, y1);
    const uint32_t out = uint32_t(q > g.q_max) | uint32_t(x0 > ex) | uint32_t(x1 < -ex) |
                         uint32_t(y0 > ey) | uint32_t(y1 < -ey);
    mask |= (out ^ 1u) << cell;
  }
  return mask;
}

// Gathers entries [start, start + n) of a tile and sorts them into its cells that are alive. A
// record is one (entry, cell); those of an entry are adjacent.
template <class T>
void load_chunk(const Job& job, const Inputs<T>& in, const Plan<T>& plan, const Tile<T>& tile,
                int64_t start, int n, int64_t channels, uint32_t alive, bool again,
                Scratch<T>& s) {
  constexpr int AHEAD = 8;
  for (int cell = 0; cell < CELLS; ++cell) s.length[cell] = 0;
  int records = 0;
  for (int k = 0; k < n; ++k) {
    const int64_t i = plan.entries[start + k];
    s.entry[k] = plan.ellipses[i];
    if (k + AHEAD < n) __builtin_prefetch(&plan.ellipses[plan.entries[start + k + AHEAD]]);
    T* f = s.features.get() + k * channels;
    for (int64_t j = 0; j < job.C; ++j) f[j] = in.features[i * job.C + j];
    if (channels > job.C) f[job.C] = in.depths[i];
    uint32_t mask = again ? plan.cells[start + k]
                          : reached_cells(s.entry[k], T(tile.x + 0.5), T(tile.y + 0.5));
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

template <class T> struct Pixels {  // centres of one register of pixels
  Vec<T> x, y;
};

template <class T> INLINE Pixels<T> pixels_of(const Tile<T>& tile, int cell, int sub) {
  constexpr int W = Simd<T>::W;
  alignas(64) static constexpr T X[LANES] = {0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5,
                                             0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5};
  alignas(64) static constexpr T Y[LANES] = {0.5, 0.5, 0.5, 0.5, 1.5, 1.5, 1.5, 1.5,
                                             2.5, 2.5, 2.5, 2.5, 3.5, 3.5, 3.5, 3.5};
  return {load(X + sub * W) + T(int(tile.x) + cell % 4 * CELL),
          load(Y + sub * W) + T(int(tile.y) + cell / 4 * CELL)};
}

template <class T> struct Cutoffs {
  T alpha_min, transmittance_min, alpha_max;
};

template <class T> struct Hit {
  Vec<T> e, raw, alpha;  // exp(-q/2), o e, and min(alpha_max, o e) or 0 where skipped
};

template <class T>
INLINE Hit<T> hit(const Ellipse<T>& g, const Pixels<T>& p, Vec<T> transmittance,
                  const Cutoffs<T>& cut) {
  using V = Vec<T>;
  const V zero = splat<T>(0), cap = splat<T>(cut.alpha_max);
  const V dx = p.x - g.mx, dy = p.y - g.my;
  Hit<T> h;
  h.e = exponential<T>(dx * (g.a * dx + g.b * dy) + g.c * dy * dy);
  h.raw = h.e * g.opacity;
  V alpha = h.raw < cap ? h.raw : cap;
  alpha = alpha >= splat<T>(cut.alpha_min) ? alpha : zero;
  alpha = transmittance >= splat<T>(cut.transmittance_min) ? alpha : zero;
  const V ax = dx < zero ? -dx : dx, ay = dy < zero ? -dy : dy;
  alpha = ax <= splat<T>(g.ex) ? alpha : zero;
  h.alpha = ay <= splat<T>(g.ey) ? alpha : zero;
  return h;
}

// ----------------------------------------------------------------------------------------- forward

// picture[c] += sum over i of w_i f_ic, for G channels of one register of pixels.
template <class T, int G>
void add_channels(const T* weights, const int32_t* list, int n, const T* features, int64_t stride,
                  T* picture) {
  using V = Vec<T>;
  constexpr int W = Simd<T>::W;
  V acc[G];
  for (int g = 0; g < G; ++g) acc[g] = load(picture + g * PIXELS);
  for (int i = 0; i < n; ++i) {
    const V w = load(weights + i * W);
    const T* f = features + list[i] * stride;
    for (int g = 0; g < G; ++g) acc[g] += w * f[g];
  }
  for (int g = 0; g < G; ++g) store(picture + g * PIXELS, acc[g]);
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

// Composites a chunk into one cell. False when all its pixels have stopped.
template <class T>
bool forward_cell(const Tile<T>& tile, int cell, int64_t channels, const Cutoffs<T>& cut,
                  Scratch<T>& s) {
  using V = Vec<T>;
  constexpr int W = Simd<T>::W;
  constexpr int PATIENCE = 8;  // entries between looks whether all pixels have stopped
  const int n = s.length[cell];
  const int32_t* list = s.list[cell];
  bool alive = false;
  for (int sub = 0; sub < SUBS<T>; ++sub) {
    const Pixels<T> p = pixels_of(tile, cell, sub);
    T* t_at = s.transmittance.get() + cell * LANES + sub * W;
    V t = load(t_at);
    bool going = true;
    int i = 0;
    while (i < n && (going = any_at_least<T>(t, cut.transmittance_min))) {
      const int end = std::min(n, i + PATIENCE);
      for (; i < end; ++i) {
        const Hit<T> h = hit(s.entry[list[i]], p, t, cut);
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

template <class T> void start_transmittance(const Tile<T>& t, T* to) {
  for (int y = 0; y < TILE; ++y)  // pixels outside the picture have stopped: -1 is below any bound
    for (int x = 0; x < TILE; ++x) to[pixel_of(x, y)] = x < t.width && y < t.height ? T(1) : T(-1);
}

template <class T>
void forward_tile(const Job& job, const Inputs<T>& in, Plan<T>& plan, int64_t index,
                  Scratch<T>& s) {
  const Tile<T> tile = tile_at(job, plan, index);
  const int64_t start = plan.tile_start[index], end = plan.tile_start[index + 1];
  const int64_t plane = job.H * job.W, channels = job.C + (job.out_depth != nullptr);
  T* features = static_cast<T*>(job.out_features) + tile.b * job.C * plane;
  T* alpha = static_cast<T*>(job.out_alpha) + tile.b * plane;
  T* depth = job.out_depth ? static_cast<T*>(job.out_depth) + tile.b * plane : nullptr;
  if (start == end) return;
  const Cutoffs<T> cut{T(job.alpha_min), T(job.transmittance_min), T(job.alpha_max)};
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
      if (s.length[cell] && !forward_cell(tile, cell, channels, cut, s))
        alive &= ~(1u << cell);
  }
  plan.chunks_done[index] = chunk;
  for (int64_t c = 0; c < job.C; ++c)
    write_plane(features + c * plane, job.W, tile, s.image.get() + c * PIXELS);
  if (depth) write_plane(depth, job.W, tile, s.image.get() + job.C * PIXELS);
  for (int k = 0; k < PIXELS; ++k) s.transmittance[k] = T(1) - s.transmittance[k];
  write_plane(alpha, job.W, tile, s.transmittance.get());
}

// Clears the empty tiles in a row of tiles of planes [H, W], one plane a channel; whole runs of
// them, because writing tile by tile across many planes is slow.
template <class T>
void clear_row(const Job& job, const Plan<T>& plan, int64_t row, T* planes, int64_t count) {
  const int64_t* start = plan.tile_start.data() + row * plan.tiles_x;
  const int64_t b = row / plan.tiles_y, top = row % plan.tiles_y * TILE;
  const int64_t bottom = std::min(job.H, top + TILE);
  for (int64_t x = 0; x < plan.tiles_x;) {
    int64_t end = x;
    while (end < plan.tiles_x && start[end] == start[end + 1]) ++end;
    const int64_t left = x * TILE, right = std::min(job.W, end * TILE);
    if (end > x)
      for (int64_t c = b * count; c < (b + 1) * count; ++c)
        for (int64_t y = top; y < bottom; ++y)
          std::fill(planes + (c * job.H + y) * job.W + left,
                    planes + (c * job.H + y) * job.W + right, T(0));
    x = end + 1;
  }
}

// ---------------------------------------------------------------------------------------- backward

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
void backward_cell(const Tile<T>& tile, int cell, int64_t channels, const Cutoffs<T>& cut,
                   Scratch<T>& s) {
  using V = Vec<T>;
  constexpr int W = Simd<T>::W;
  const int n = s.length[cell];
  const int32_t *list = s.list[cell], *record = s.record[cell];
  const V zero = splat<T>(0), cap = splat<T>(cut.alpha_max);
  for (int sub = 0; sub < SUBS<T>; ++sub) {
    const Pixels<T> p = pixels_of(tile, cell, sub);
    const int lane = cell * LANES + sub * W;
    V t = load(s.transmittance.get() + lane);
    const V alpha_grad = load(s.alpha_grad.get() + lane);
    for (int i = 0; i < n; ++i) {
      const Hit<T> h = hit(s.entry[list[i]], p, t, cut);
      // The opacity's and q's gradient: none where alpha is capped or the Gaussian was skipped.
      V e = h.raw > cap ? zero : h.e;
      e = h.raw >= splat<T>(cut.alpha_min) ? e : zero;
      e = t >= splat<T>(cut.transmittance_min) ? e : zero;
      const V dx = p.x - s.entry[list[i]].mx, dy = p.y - s.entry[list[i]].my;
      const V ax = dx < zero ? -dx : dx, ay = dy < zero ? -dy : dy;
      e = ax <= splat<T>(s.entry[list[i]].ex) ? e : zero;
      e = ay <= splat<T>(s.entry[list[i]].ey) ? e : zero;
      store(s.e.get() + i * W, e * t);
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

// Sums an entry's records into its gradients with respect to mean, conic and opacity.
template <class T>
void entry_geometry(const Tile<T>& tile, int k, const Scratch<T>& s, T* out) {
  using V = Vec<T>;
  constexpr int W = Simd<T>::W;
  const Ellipse<T>& g = s.entry[k];
  V o = splat<T>(0), x = o, y = o, xx = o, xy = o, yy = o;
  const T* record = s.record_g.get() + s.first[k] * LANES;
  for (uint32_t mask = s.mask[k]; mask; mask &= mask - 1) {
    const int cell = __builtin_ctz(mask);
    for (int sub = 0; sub < SUBS<T>; ++sub, record += W) {
      const Pixels<T> p = pixels_of(tile, cell, sub);
      const V dx = p.x - g.mx, dy = p.y - g.my, w = load(record);
      const V wx = w * dx, wy = w * dy;
      o += w;
      x += wx;
      y += wy;
      xx += wx * dx;
      xy += wx * dy;
      yy += wy * dy;
    }
  }
  // dalpha/dq = -alpha / 2; g.a = -a / 2, g.b = -b, g.c = -c / 2.
  const T sx = sum<T>(x) * g.opacity, sy = sum<T>(y) * g.opacity;
  out[0] = -(2 * g.a * sx + g.b * sy);
  out[1] = -(g.b * sx + 2 * g.c * sy);
  out[2] = T(-0.5) * g.opacity * sum<T>(xx);
  out[3] = -g.opacity * sum<T>(xy);
  out[4] = T(-0.5) * g.opacity * sum<T>(yy);
  out[5] = sum<T>(o);
}

// Sums an entry's records into its gradients with respect to G features.
template <class T, int G>
void entry_features(int k, const Scratch<T>& s, const T* grad, T* out) {
  using V = Vec<T>;
  constexpr int W = Simd<T>::W;
  V acc[G];
  for (int g = 0; g < G; ++g) acc[g] = splat<T>(0);
  const T* record = s.record_w.get() + s.first[k] * LANES;
  for (uint32_t mask = s.mask[k]; mask; mask &= mask - 1) {
    const T* at = grad + __builtin_ctz(mask) * LANES;
    for (int sub = 0; sub < SUBS<T>; ++sub, record += W, at += W) {
      const V w = load(record);
      for (int g = 0; g < G; ++g) acc[g] += w * load(at + g * PIXELS);
    }
  }
  for (int g = 0; g < G; ++g) out[g] = sum<T>(acc[g]);
}

// Gradients of a tile's entries; slots [entries of the tile, GEOMETRY + channels].
template <class T>
void backward_tile(const Job& job, const Inputs<T>& in, const Plan<T>& plan, int64_t index,
                   Scratch<T>& s, T* slots) {
  const Tile<T> tile = tile_at(job, plan, index);
  const int64_t start = plan.tile_start[index], end = plan.tile_start[index + 1];
  const int64_t plane = job.H * job.W, channels = job.C + (job.g_depth != nullptr);
  const int64_t stride = GEOMETRY + channels;
  if (start == end) return;
  const Cutoffs<T> cut{T(job.alpha_min), T(job.transmittance_min), T(job.alpha_max)};
  const T* g_features = static_cast<const T*>(job.g_features);
  const T* g_alpha = static_cast<const T*>(job.g_alpha);
  const T* g_depth = static_cast<const T*>(job.g_depth);
  for (int64_t c = 0; c < job.C; ++c) {
    T* to = s.image.get() + c * PIXELS;
    if (g_features)
      read_plane(g_features + (tile.b * job.C + c) * plane, job.W, tile, to);
    else
      std::fill_n(to, PIXELS, T(0));
  }
  if (g_depth)
    read_plane(g_depth + tile.b * plane, job.W, tile, s.image.get() + job.C * PIXELS);
  if (g_alpha)
    read_plane(g_alpha + tile.b * plane, job.W, tile, s.alpha_grad.get());
  else
    std::fill_n(s.alpha_grad.get(), PIXELS, T(0));
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
      if (s.length[cell]) backward_cell(tile, cell, channels, cut, s);
    for (int k = 0; k < n; ++k) {
      T* slot = slots + (at - start + k) * stride;
      entry_geometry(tile, k, s, slot);
      in_groups(channels, [&](int64_t c, auto size) {
        entry_features<T, decltype(size)::value>(k, s, s.image.get() + c * PIXELS,
                                                 slot + GEOMETRY + c);
      });
    }
  }
}

// Adds the slots of entries [from, to) to the Gaussians' gradients, in the order of the tiles.
template <class T>
void reduce(const Job& job, const Plan<T>& plan, const T* slots, int64_t from, int64_t to,
            std::vector<int64_t>& cursor) {
  const int64_t total = job.B * job.N, channels = job.C + (job.g_depth != nullptr);
  const int64_t stride = GEOMETRY + channels;
  T* d_means = static_cast<T*>(job.d_means);
  T* d_conics = static_cast<T*>(job.d_conics);
  T* d_opacities = static_cast<T*>(job.d_opacities);
  T* d_features = static_cast<T*>(job.d_features);
  T* d_depths = static_cast<T*>(job.d_depths);
#pragma omp parallel for schedule(static) num_threads(int(job.threads))
  for (int64_t i = 0; i < total; ++i) {
    for (; cursor[i] < plan.gaussian_start[i + 1]; ++cursor[i]) {
      const int64_t entry = plan.position[cursor[i]];
      if (entry >= to) break;
      const T* slot = slots + (entry - from) * stride;
      for (int k = 0; k < 2; ++k) d_means[2 * i + k] += slot[k];
      for (int k = 0; k < 3; ++k) d_conics[3 * i + k] += slot[2 + k];
      d_opacities[i] += slot[5];
      for (int64_t c = 0; c < job.C; ++c) d_features[i * job.C + c] += slot[GEOMETRY + c];
      if (d_depths) d_depths[i] += slot[GEOMETRY + job.C];
    }
  }
}

// ------------------------------------------------------------------------------------------- calls

int thread_index() {
#ifdef _OPENMP
  return omp_get_thread_num();
#else
  return 0;
#endif
}

template <class T>
std::vector<std::unique_ptr<Scratch<T>>> scratches(const Job& job, int64_t channels, bool back) {
  std::vector<std::unique_ptr<Scratch<T>>> all;
  for (int64_t t = 0; t < job.threads; ++t)
    all.push_back(std::make_unique<Scratch<T>>(channels, back));
  return all;
}

template <class T> int forward(Job& job, void** handle) {
  try {
    auto plan = std::make_unique<Plan<T>>();
    const Status status = bin(job, *plan);
    if (status != OK) return status;
    const Inputs<T> in(job);
    auto scratch = scratches<T>(job, job.C + (job.out_depth != nullptr), false);
#pragma omp parallel num_threads(int(job.threads))
    {
#pragma omp for schedule(dynamic, 1) nowait
      for (int64_t t = 0; t < plan->tiles; ++t)
        forward_tile(job, in, *plan, t, *scratch[thread_index()]);
#pragma omp for schedule(dynamic, 1)
      for (int64_t row = 0; row < job.B * plan->tiles_y; ++row) {
        clear_row(job, *plan, row, static_cast<T*>(job.out_features), job.C);
        clear_row(job, *plan, row, static_cast<T*>(job.out_alpha), 1);
        if (job.out_depth) clear_row(job, *plan, row, static_cast<T*>(job.out_depth), 1);
      }
    }
    *handle = job.keep ? plan.release() : nullptr;
    return OK;
  } catch (const std::bad_alloc&) {
    return OUT_OF_MEMORY;
  }
}

template <class T> int backward(Job& job, const void* handle) {
  try {
    const Plan<T>& plan = *static_cast<const Plan<T>*>(handle);
    const Inputs<T> in(job);
    const int64_t channels = job.C + (job.g_depth != nullptr), stride = GEOMETRY + channels;
    const int64_t budget = std::max<int64_t>(1, job.slot_bytes / int64_t(stride * sizeof(T)));
    auto scratch = scratches<T>(job, channels, true);
    std::vector<int64_t> cursor(plan.gaussian_start.begin(), plan.gaussian_start.end() - 1);
    Buffer<T> slots;
    int64_t room = 0;
    for (int64_t first = 0; first < plan.tiles;) {  // as many tiles at a time as the budget holds
      int64_t last = first + 1;
      while (last < plan.tiles && plan.tile_start[last + 1] - plan.tile_start[first] <= budget)
        ++last;
      const int64_t from = plan.tile_start[first], to = plan.tile_start[last];
      if (to - from > room) slots.resize((room = to - from) * stride);
#pragma omp parallel for schedule(dynamic, 1) num_threads(int(job.threads))
      for (int64_t t = first; t < last; ++t)
        backward_tile(job, in, plan, t, *scratch[thread_index()],
                      slots.get() + (plan.tile_start[t] - from) * stride);
      reduce(job, plan, slots.get(), from, to, cursor);
      first = last;
    }
    return OK;
  } catch (const std::bad_alloc&) {
    return OUT_OF_MEMORY;
  }
}

}  // namespace

extern "C" {

int64_t gsgan_job_size() { return sizeof(Job); }
int gsgan_has_openmp() {
#ifdef _OPENMP
  return 1;
#else
  return 0;
#endif
}
int gsgan_forward_float32(Job* job, void** plan) { return forward<float>(*job, plan); }
int gsgan_forward_float64(Job* job, void** plan) { return forward<double>(*job, plan); }
int gsgan_backward_float32(Job* job, const void* plan) { return backward<float>(*job, plan); }
int gsgan_backward_float64(Job* job, const void* plan) { return backward<double>(*job, plan); }
void gsgan_free_float32(void* plan) { delete static_cast<Plan<float>*>(plan); }
void gsgan_free_float64(void* plan) { delete static_cast<Plan<double>*>(plan); }
}
