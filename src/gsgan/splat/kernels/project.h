// Projection of all Gaussians, forward and backward.
#pragma once

#include <algorithm>
#include <new>
#include <vector>

#include "ewa.h"
#include "job.h"

namespace gsgan {

constexpr int PROJECT_BLOCK = 256;  // Gaussians per task; the camera's gradient is summed per task

template <class T> const T* as(const void* p) { return static_cast<const T*>(p); }
template <class T> T* as(void* p) { return static_cast<T*>(p); }
template <class T> T* at(void* p, int64_t i) { return p ? static_cast<T*>(p) + i : nullptr; }

template <class T> Vec3 in_camera(const ProjectJob& job, const Camera& camera, int64_t i) {
  return camera.R * read3(as<T>(job.means) + 3 * i) + camera.t;
}

inline bool usable(const ProjectJob& job, int64_t i, double z) {
  return z > job.near;
}

template <class T> Blurred blurred(const ProjectJob& job, int64_t i, const View& view) {
  const T *quats = as<T>(job.quats) + 4 * i, *scales = as<T>(job.scales) + 3 * i;
  const Cov2 cov = job.covariances
                       ? GivenCovariance(as<T>(job.covariances) + 9 * i, view).covariance()
                       : RotatedScales(quats, scales, job.quat_min, view).covariance();
  return {cov, job.low_pass, job.antialias != 0};
}

// The footprint's half-sizes; false when it is not visible.
inline bool footprint(const ProjectJob& job, const Cov2& cov, double opacity, double x, double y,
                      double& ex, double& ey) {
  double reach = job.reach;
  if (reach < 0) reach = std::sqrt(2 * std::fmax(std::log(opacity / job.alpha_min), 0.0));
  reach = reach * (1 + job.extent_margin) + job.extent_margin;
  ex = reach * std::sqrt(cov.a);
  ey = reach * std::sqrt(cov.c);
  // The outermost pixel centres are half a pixel inside the image.
  return x + ex >= 0.5 && y + ey >= 0.5 && x - ex <= job.W - 0.5 && y - ey <= job.H - 0.5 &&
         opacity >= job.alpha_min;
}

template <class T> void project_one(const ProjectJob& job, const Camera& camera, int64_t i) {
  Vec3 at = in_camera<T>(job, camera, i);
  const bool front = usable(job, i, at.z);
  if (!front) at = {0, 0, 1};
  const View view(camera, at);
  const double x = view.pixel_x(camera), y = view.pixel_y(camera);
  double p = 1, k = 0, r = 1, opacity = 0, ex = 0, ey = 0;
  bool seen = false;
  if (front) {
    const Blurred blur = blurred<T>(job, i, view);
    p = blur.p, k = blur.k, r = blur.r;
    opacity = as<T>(job.opacities)[i] * blur.kept;
    seen = footprint(job, blur.after, opacity, x, y, ex, ey);
  }
  job.out_means[2 * i] = x;
  job.out_means[2 * i + 1] = y;
  write3(job.out_factors + 3 * i, {p, k, r});
  as<T>(job.out_opacities)[i] = T(opacity);
  job.out_depths[i] = at.z;
  as<T>(job.out_extents)[2 * i] = T(seen ? ex : 0);
  as<T>(job.out_extents)[2 * i + 1] = T(seen ? ey : 0);
  job.visible[i] = seen;
}

// Absent gradients are 0; invisible Gaussians keep zero gradients.
template <class T>
void project_one_backward(const ProjectJob& job, const Camera& camera, int64_t i,
                          CameraGradient& sum) {
  const double g_x = job.g_means ? job.g_means[2 * i] : 0;
  const double g_y = job.g_means ? job.g_means[2 * i + 1] : 0;
  const Vec3 g = job.g_factors ? read3(job.g_factors + 3 * i) : Vec3{};
  const double g_o = job.g_opacities ? double(as<T>(job.g_opacities)[i]) : 0;
  const double g_z = job.g_depths ? job.g_depths[i] : 0;
  if (g_x == 0 && g_y == 0 && g.x == 0 && g.y == 0 && g.z == 0 && g_o == 0 && g_z == 0) return;
  const Vec3 in = in_camera<T>(job, camera, i);
  if (!usable(job, i, in.z)) return;
  const View view(camera, in);
  const Blurred blur = blurred<T>(job, i, view);
  const double opacity = as<T>(job.opacities)[i];
  const double g_kept = job.antialias ? g_o * opacity : 0;
  const Cov2 cov = blur.backward(g.x, g.y, g.z, g_kept, job.low_pass);
  Vec3 j0, j1;
  if (job.covariances)
    GivenCovariance(as<T>(job.covariances) + 9 * i, view)
        .backward(view, cov, j0, j1, at<T>(job.d_covariances, 9 * i));
  else
    RotatedScales(as<T>(job.quats) + 4 * i, as<T>(job.scales) + 3 * i, job.quat_min, view)
        .backward(view, cov, j0, j1, at<T>(job.d_quats, 4 * i), at<T>(job.d_scales, 3 * i));
  const Vec3 d = view.backward(camera, g_x, g_y, j0, j1, g_z, sum);
  add_outer(sum.R, d, read3(as<T>(job.means) + 3 * i));
  sum.t = sum.t + d;
  if (job.d_means) write3(as<T>(job.d_means) + 3 * i, transposed_times(camera.R, d));
  if (job.d_opacities) as<T>(job.d_opacities)[i] = T(g_o * blur.kept);
}

inline void write_gradient(const ProjectJob& job, int64_t b, const Camera& c,
                           const CameraGradient& g) {
  const auto upper = [&](Vec3 k, Vec3 kr) {
    return k + Vec3{dot(kr, c.R.x), dot(kr, c.R.y), 0};
  };
  write33(job.d_K + 9 * b, {upper(g.k0, g.kr0), upper(g.k1, g.kr1), {}});
  write33(job.d_R + 9 * b, {g.R.x + c.k0.x * g.kr0 + c.k1.x * g.kr1,
                            g.R.y + c.k0.y * g.kr0 + c.k1.y * g.kr1, g.R.z});
  write3(job.d_t + 3 * b, g.t);
  const double limits[] = {g.low_x, g.low_y, g.high_x, g.high_y};
  std::copy_n(limits, 4, job.d_limits + 4 * b);
}

template <class T, class F> void in_blocks(const ProjectJob& job, F&& f) {
  const int64_t per_item = (job.N + PROJECT_BLOCK - 1) / PROJECT_BLOCK;
#pragma omp parallel for schedule(static) num_threads(int(job.threads))
  for (int64_t block = 0; block < job.B * per_item; ++block) {
    const int64_t b = block / per_item, first = block % per_item * PROJECT_BLOCK;
    const Camera camera(job, b);
    for (int64_t n = first; n < std::min(job.N, first + PROJECT_BLOCK); ++n)
      f(camera, block, b * job.N + n);
  }
}

template <class T> int project(const ProjectJob& job) {
  in_blocks<T>(job, [&](const Camera& camera, int64_t, int64_t i) {
    project_one<T>(job, camera, i);
  });
  return OK;
}

template <class T> int project_backward(const ProjectJob& job) {
  try {
    const int64_t per_item = (job.N + PROJECT_BLOCK - 1) / PROJECT_BLOCK;
    std::vector<CameraGradient> sums(job.B * per_item);
    in_blocks<T>(job, [&](const Camera& camera, int64_t block, int64_t i) {
      project_one_backward<T>(job, camera, i, sums[block]);
    });
    for (int64_t b = 0; b < job.B; ++b) {  // in order: the result does not depend on threads
      CameraGradient total;
      for (int64_t k = b * per_item; k < (b + 1) * per_item; ++k) total.add(sums[k]);
      write_gradient(job, b, Camera(job, b), total);
    }
    return OK;
  } catch (const std::bad_alloc&) {
    return OUT_OF_MEMORY;
  }
}

}  // namespace gsgan
