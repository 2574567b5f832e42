// The body solve of splat/kernels for the web page: landmarks in, transforms of bones out.
// Built into solve.wasm by `npm run wasm`; see docs/web.md.
#include <cstdlib>

#include "../../splat/kernels/solve.h"

void* operator new(size_t size) { return std::malloc(size); }
void operator delete(void* at) noexcept { std::free(at); }
void operator delete(void* at, size_t) noexcept { std::free(at); }

// As gsgan.export.web packs it: a job whose addresses count from its own start.
struct Body {
  SolveJob job;
  const int64_t* parents;  // [J] of the body's joints, -1 for the root
};

extern "C" {
void* room(size_t bytes) { return std::malloc(bytes); }

void place(Body* body) {
  auto* first = reinterpret_cast<uintptr_t*>(&body->job.joint);
  for (auto* at = first; at < reinterpret_cast<uintptr_t*>(body + 1); ++at)
    if (*at) *at += reinterpret_cast<uintptr_t>(body);
}

// One frame; hands and seen are null where it has none. Writes theta [J, 3] and transl [3].
void solve(Body* body, const float* p, const float* visibility, const uint8_t* valid,
           const float* hands, const uint8_t* seen, float* theta, float* transl) {
  SolveJob& job = body->job;
  job.p = p, job.visibility = visibility, job.valid = valid, job.hands = hands, job.seen = seen;
  job.theta = theta, job.transl = transl;
  gsgan::solve<float>(job);
}

// forward_kinematics of body/lbs.py: bones [J, 12], the rows of A then t.
void move(const Body* body, const float* theta, const float* transl, float* bones) {
  using namespace gsgan;
  const SolveJob& job = body->job;
  std::vector<Mat3> R(job.J);
  std::vector<Vec3> at(job.J);
  for (int64_t j = 0; j < job.J; ++j) {
    const int64_t parent = body->parents[j];
    const Vec3 rest = read3(job.joints + 3 * j);
    const Mat3 own = rotation_of(read3(theta + 3 * j));
    R[j] = parent < 0 ? own : R[parent] * own;
    at[j] = parent < 0 ? rest + read3(transl)
                       : at[parent] + R[parent] * (rest - read3(job.joints + 3 * parent));
    float* out = bones + 12 * j;
    const Vec3 shift = at[j] - R[j] * rest;
    write3(out, R[j].x), write3(out + 3, R[j].y), write3(out + 6, R[j].z);
    write3(out + 9, shift);
  }
}
}
