// The caller's job, what the backward pass needs of the forward pass, and their memory.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <new>
#include <vector>

extern "C" {

// Mirrors native.py's _Job field by field. Arrays are contiguous; null where not needed.
struct Job {
  int64_t B, N, C, H, W;
  int64_t threads;
  int64_t keep;        // whether a backward pass will follow
  int64_t box;         // whether pixels outside the extents are skipped, whatever their alpha
  int64_t slot_bytes;  // memory for per-entry gradients in the backward pass
  int64_t times;       // pixels averaged each way, a divisor of TILE; above 1 alpha is averaged
  int64_t rows;        // whether features and their gradient are channels last
  double alpha_min, transmittance_min, alpha_max;
  const double *means, *factors;
  const void *opacities, *features;
  const double* depths;  // in T, close ones could be equal
  const void* extents;
  const uint8_t* visible;
  void *out_features, *out_alpha, *out_average;  // zeros on entry
  const void *g_features, *g_alpha, *g_average;
  double *d_means, *d_factors;
  void *d_opacities, *d_features;
  int64_t bad;  // out: index of a Gaussian that is not finite
};

enum Status { OK = 0, OUT_OF_MEMORY = 1, NOT_FINITE = 2, TOO_MANY = 3 };
}

namespace gsgan {

constexpr int TILE = 16;             // pixels; 8 and 32 were slower
constexpr int CELL = 4;              // pixels
constexpr int CELLS = 16;            // per tile
constexpr int LANES = CELL * CELL;   // pixels per cell
constexpr int PIXELS = TILE * TILE;  // per tile, stored cell by cell
constexpr int CHUNK = 64;            // entries of a tile's list that are processed at a time

template <class T> class Buffer {  // aligned to at least a cache line, uninitialised
 public:
  Buffer() = default;
  explicit Buffer(size_t n) { resize(n); }
  void resize(size_t n) {
    void* p = nullptr;
    const size_t alignment = std::max<size_t>(64, alignof(T));
    if (posix_memalign(&p, alignment, std::max<size_t>(n, 1) * sizeof(T)) != 0)
      throw std::bad_alloc();
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

// The job's arrays with their types. Geometry is always double: a needle's q is a difference of
// numbers as large as its distance, until it is computed relative to a tile.
template <class T> struct Inputs {
  explicit Inputs(const Job& j)
      : means(j.means),
        factors(j.factors),
        depths(j.depths),
        opacities(static_cast<const T*>(j.opacities)),
        features(static_cast<const T*>(j.features)),
        extents(static_cast<const T*>(j.extents)) {}
  const double *means, *factors, *depths;
  const T *opacities, *features, *extents;
};

// A Gaussian prepared for the tiles: one cache line in float. With (dx, dy) from its mean,
//   u = p (dx + k dy), v = r dy, alpha = opacity 2^-(u^2 + v^2):
// p and r include the factor sqrt(log2(e) / 2) of the exponent.
template <class T> struct alignas(16 * sizeof(T)) Ellipse {
  double mx, my, k;
  T p, r, opacity;
  T ex, ey;
  T level;  // where u^2 + v^2 > level, alpha < alpha_min
};
constexpr double UNITS = 0.84932180028801904272;  // sqrt(log2(e) / 2)

// What the backward pass needs of the forward pass, in addition to its inputs.
template <class T> struct Plan {
  int64_t tiles_x = 0, tiles_y = 0, tiles = 0;  // tiles: of all batch items
  std::vector<int64_t> tile_start;              // [tiles + 1] into entries
  std::vector<int64_t> gaussian_start;          // [B N + 1] into position
  Buffer<Ellipse<T>> ellipses;       // [B N]; undefined for Gaussians without entries
  Buffer<int32_t> entries;           // Gaussian (b N + n) of each entry: tile by tile, front to back
  Buffer<uint16_t> cells;            // cells of its tile that each entry reaches, one bit each
  Buffer<uint32_t> position;         // entry of each (Gaussian, tile): Gaussian by Gaussian
  std::vector<int64_t> chunk_start;  // [tiles + 1] into checkpoints
  std::vector<int32_t> chunks_done;  // [tiles] chunks processed before every pixel had stopped
  Buffer<T> checkpoints;             // [chunks, PIXELS] transmittance before each chunk
};

}  // namespace gsgan
