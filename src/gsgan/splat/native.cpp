// Projection and compositing of Gaussians on the CPU: forward and hand-written backward.
//
// Compiled on first use and called through ctypes; needs a C++17 compiler with vector extensions
// (gcc, clang), nothing of torch. Contract and definitions: see native.py, native_project.py.
//
// How it works
//   project.h   projects one Gaussian at a time, in double; the formulas are in ewa.h.
//   bin.h       sorts Gaussians, in depth order, into lists of 16 x 16 pixel tiles.
//   tile.h      processes a list in chunks; a tile has 16 cells of 4 x 4 pixels, and each cell gets
//               the sub-list of the Gaussians that can reach it. A cell is 16 pixels: one AVX-512
//               register of floats, two of AVX, four of SSE or NEON.
//   place.h     shifts an ellipse to the tile's centre in double, then rounds: a needle's q is
//               accurate for any length and any distance of its mean.
//   forward.h   composites a cell, front to back.
//   backward.h  per cell, back to front; gradients are written per (tile, Gaussian) and added in a
//               fixed order: the result does not depend on the number of threads.

#include "kernels/backward.h"
#include "kernels/bin.h"
#include "kernels/compose.h"
#include "kernels/forward.h"
#include "kernels/photometric.h"
#include "kernels/project.h"
#include "kernels/skin.h"
#include "kernels/solve.h"

#ifdef _OPENMP
#include <omp.h>
#endif

namespace gsgan {

inline int thread_index() {
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
    auto scratch = scratches<T>(job, job.C, false);
#pragma omp parallel for schedule(dynamic, 1) num_threads(int(job.threads))
    for (int64_t t = 0; t < plan->tiles; ++t)
      forward_tile(job, in, *plan, t, *scratch[thread_index()]);
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
    const int64_t stride = GEOMETRY + job.C;
    const int64_t budget = std::max<int64_t>(1, job.slot_bytes / int64_t(stride * sizeof(T)));
    auto scratch = scratches<T>(job, job.C, true);
    std::vector<int64_t> cursor(plan.gaussian_start.begin(), plan.gaussian_start.end() - 1);
    std::vector<double> sums(job.B * job.N * GEOMETRY, 0.0);
    Buffer<T> slots;
    int64_t room = 0;
    for (int64_t first = 0; first < plan.tiles;) {  // as many tiles at a time as the budget allows
      int64_t last = first + 1;
      while (last < plan.tiles && plan.tile_start[last + 1] - plan.tile_start[first] <= budget)
        ++last;
      const int64_t from = plan.tile_start[first], to = plan.tile_start[last];
      if (to - from > room) slots.resize((room = to - from) * stride);
#pragma omp parallel for schedule(dynamic, 1) num_threads(int(job.threads))
      for (int64_t t = first; t < last; ++t)
        backward_tile(job, in, plan, t, *scratch[thread_index()],
                      slots.get() + (plan.tile_start[t] - from) * stride);
      reduce(job, plan, slots.get(), from, to, cursor, sums.data());
      first = last;
    }
    geometry_gradient(job, plan, sums.data());
    return OK;
  } catch (const std::bad_alloc&) {
    return OUT_OF_MEMORY;
  }
}

}  // namespace gsgan

extern "C" {

int64_t gsgan_job_size() { return sizeof(Job); }
int gsgan_has_openmp() {
#ifdef _OPENMP
  return 1;
#else
  return 0;
#endif
}
int gsgan_forward_float32(Job* job, void** plan) { return gsgan::forward<float>(*job, plan); }
int gsgan_forward_float64(Job* job, void** plan) { return gsgan::forward<double>(*job, plan); }
int gsgan_backward_float32(Job* job, const void* plan) {
  return gsgan::backward<float>(*job, plan);
}
int gsgan_backward_float64(Job* job, const void* plan) {
  return gsgan::backward<double>(*job, plan);
}
void gsgan_free_float32(void* plan) { delete static_cast<gsgan::Plan<float>*>(plan); }
void gsgan_free_float64(void* plan) { delete static_cast<gsgan::Plan<double>*>(plan); }
int64_t gsgan_project_job_size() { return sizeof(ProjectJob); }
int gsgan_project_float32(const ProjectJob* job) { return gsgan::project<float>(*job); }
int gsgan_project_float64(const ProjectJob* job) { return gsgan::project<double>(*job); }
int gsgan_project_backward_float32(const ProjectJob* job) {
  return gsgan::project_backward<float>(*job);
}
int gsgan_project_backward_float64(const ProjectJob* job) {
  return gsgan::project_backward<double>(*job);
}
int gsgan_compose_float32(const ComposeJob* job) { return gsgan::compose<float>(*job); }
int gsgan_compose_float64(const ComposeJob* job) { return gsgan::compose<double>(*job); }
int gsgan_compose_backward_float32(const ComposeJob* job) {
  return gsgan::compose_backward<float>(*job);
}
int gsgan_compose_backward_float64(const ComposeJob* job) {
  return gsgan::compose_backward<double>(*job);
}
int gsgan_skin_float32(const SkinJob* job) { return gsgan::skin<float>(*job); }
int gsgan_skin_float64(const SkinJob* job) { return gsgan::skin<double>(*job); }
int gsgan_skin_backward_float32(const SkinJob* job) { return gsgan::skin_backward<float>(*job); }
int gsgan_skin_backward_float64(const SkinJob* job) { return gsgan::skin_backward<double>(*job); }
int64_t gsgan_solve_job_size() { return sizeof(SolveJob); }
int gsgan_solve_float32(const SolveJob* job) { return gsgan::solve<float>(*job); }
int gsgan_solve_float64(const SolveJob* job) { return gsgan::solve<double>(*job); }
int gsgan_photometric_float32(const PhotometricJob* job) { return gsgan::photometric<float>(*job); }
int gsgan_photometric_float64(const PhotometricJob* job) {
  return gsgan::photometric<double>(*job);
}
}
