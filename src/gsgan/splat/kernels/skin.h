// Linear blend skinning of points with normals and shapes, one point at a time, in double.
// Definitions: model/body_points.py, whose tensor operations are the reference.
#pragma once

#include <cmath>
#include <cstdint>

extern "C" {

// Mirrors model/compiled.py's _SkinJob. Null slopes: shapes follow the frames alone.
struct SkinJob {
  int64_t poses, count, threads;
  int64_t joints, followed, kept;         // bones: of the body, of a point, with a slope
  double floor;                           // share of the area at which a normal fades
  double limit;                           // largest norm of what slopes add to a frame
  const void* bones;                      // [poses, joints, 4, 4]
  const void *rest, *normals;             // [count, 3]
  const int64_t* index;                   // [count, followed]
  const void* weight;
  const int64_t* steep;                   // [count, kept]
  const void* slopes;                     // [count, kept, 3]
  void *out_means, *out_frames, *out_origins, *out_shapes, *out_normals;
  const void* g_means;
  void* d_weight;
};
}

namespace gsgan {

// A point moved by the first three rows of a bone's transform.
template <class T> void moved_by(const T* bone, const T* x, double* out) {
  for (int r = 0; r < 3; ++r) {
    const T* row = bone + 4 * r;
    out[r] = double(row[0]) * x[0] + double(row[1]) * x[1] + double(row[2]) * x[2] + row[3];
  }
}

// The average transform of a point's bones, 12 numbers; returns the sum of the weights.
template <class T>
double blended(const SkinJob& job, const T* bones, int64_t i, double* affine) {
  const int64_t* index = job.index + i * job.followed;
  const T* weight = static_cast<const T*>(job.weight) + i * job.followed;
  double total = 0;
  for (int k = 0; k < 12; ++k) affine[k] = 0;
  for (int64_t b = 0; b < job.followed; ++b) {
    const T* bone = bones + 16 * index[b];
    const double w = weight[b];
    total += w;
    for (int k = 0; k < 12; ++k) affine[k] += w * bone[k];
  }
  for (int k = 0; k < 12; ++k) affine[k] /= total;
  return total;
}

// The frame and the slopes of the weights: A + sum of (bone x) slope^T, whose norm is limited. The
// slopes sum to zero, so that places can be given from the root's, where numbers are small.
template <class T>
void stretched(const SkinJob& job, const T* bones, const T* x, int64_t i, double* J) {
  double pulled[9] = {}, squared = 0;
  for (int64_t b = 0; b < job.kept; ++b) {
    const int64_t row = i * job.kept + b;
    const T* slope = static_cast<const T*>(job.slopes) + 3 * row;
    double place[3];
    moved_by(bones + 16 * job.steep[row], x, place);
    for (int r = 0; r < 3; ++r)
      for (int k = 0; k < 3; ++k) pulled[3 * r + k] += (place[r] - bones[4 * r + 3]) * slope[k];
  }
  for (double value : pulled) squared += value * value;
  const double norm = std::sqrt(squared);
  const double share = norm > job.limit ? job.limit / norm : 1;
  for (int k = 0; k < 9; ++k) J[k] += share * pulled[k];
}

// The cofactors of J times the normal at rest, of length one where the surface is not flat.
template <class T> void turned(const double* J, const T* n, double floor, T* out) {
  double moved[3], squared = floor * floor;
  for (int r = 0; r < 3; ++r) {
    const double *a = J + 3 * ((r + 1) % 3), *b = J + 3 * ((r + 2) % 3);
    moved[r] = (a[1] * b[2] - a[2] * b[1]) * n[0] + (a[2] * b[0] - a[0] * b[2]) * n[1] +
               (a[0] * b[1] - a[1] * b[0]) * n[2];
    squared += moved[r] * moved[r];
  }
  for (int r = 0; r < 3; ++r) out[r] = T(moved[r] / std::sqrt(squared));
}

template <class T> void skin_one(const SkinJob& job, int64_t pose, int64_t i) {
  const T* bones = static_cast<const T*>(job.bones) + 16 * job.joints * pose;
  const T* x = static_cast<const T*>(job.rest) + 3 * i;
  const int64_t row = pose * job.count + i;
  double affine[12], J[9];
  blended(job, bones, i, affine);
  for (int r = 0; r < 3; ++r) {
    const double* a = affine + 4 * r;
    static_cast<T*>(job.out_means)[3 * row + r] = T(a[0] * x[0] + a[1] * x[1] + a[2] * x[2] + a[3]);
    static_cast<T*>(job.out_origins)[3 * row + r] = T(a[3]);
    for (int k = 0; k < 3; ++k) {
      J[3 * r + k] = a[k];
      static_cast<T*>(job.out_frames)[9 * row + 3 * r + k] = T(a[k]);
    }
  }
  if (job.slopes) {
    stretched(job, bones, x, i, J);
    for (int k = 0; k < 9; ++k) static_cast<T*>(job.out_shapes)[9 * row + k] = T(J[k]);
  }
  turned(J, static_cast<const T*>(job.normals) + 3 * i, job.floor,
         static_cast<T*>(job.out_normals) + 3 * row);
}

// The gradient of a point's weights, over all poses: only means have one.
template <class T> void skin_one_backward(const SkinJob& job, int64_t i) {
  const T* x = static_cast<const T*>(job.rest) + 3 * i;
  T* out = static_cast<T*>(job.d_weight) + i * job.followed;
  for (int64_t b = 0; b < job.followed; ++b) out[b] = 0;
  for (int64_t pose = 0; pose < job.poses; ++pose) {
    const T* bones = static_cast<const T*>(job.bones) + 16 * job.joints * pose;
    const T* g = static_cast<const T*>(job.g_means) + 3 * (pose * job.count + i);
    double affine[12], mean[3];
    const double total = blended(job, bones, i, affine);
    for (int r = 0; r < 3; ++r) {
      const double* a = affine + 4 * r;
      mean[r] = a[0] * x[0] + a[1] * x[1] + a[2] * x[2] + a[3];
    }
    for (int64_t b = 0; b < job.followed; ++b) {
      double place[3];
      moved_by(bones + 16 * job.index[i * job.followed + b], x, place);
      double along = 0;
      for (int r = 0; r < 3; ++r) along += g[r] * (place[r] - mean[r]);
      out[b] += T(along / total);
    }
  }
}

template <class T> int skin(const SkinJob& job) {
#pragma omp parallel for schedule(static) num_threads(int(job.threads))
  for (int64_t row = 0; row < job.poses * job.count; ++row)
    skin_one<T>(job, row / job.count, row % job.count);
  return 0;
}

template <class T> int skin_backward(const SkinJob& job) {
#pragma omp parallel for schedule(static) num_threads(int(job.threads))
  for (int64_t i = 0; i < job.count; ++i) skin_one_backward<T>(job, i);
  return 0;
}

}  // namespace gsgan
