// From landmarks to the pose of a body, one frame at a time, in double. Definitions: body/solve.py,
// whose tensor operations are the reference, and the ones that carry gradients.
//
// A landmark is moved by the turns on its way to the root only, so its rows of the Jacobian are short
// lists, and each adds a small block to the normal matrix.
#pragma once

#include <vector>

#include "hands.h"

extern "C" {

// Mirrors body/compiled.py's _Job field by field. Arrays are contiguous; null where not needed.
struct SolveJob {
  int64_t B, threads;
  int64_t J, T, D, E;  // the body's joints; turns, numbers and entries of its rig
  int64_t landmarks, bends, limbs, steps, rounds, placing;
  double converged, damping, easier, harder, floor, robust, beyond, held, noise, straight, sharp;
  double finger_noise, trace;
  // of body/solve.py: buffers of Solver, and its first guess
  const int64_t *joint, *parent, *entry_turn, *entry_number, *carrier;
  const double *joints, *entry_axis, *rest, *precision, *prior, *minimum, *rest_hubs, *rest_hips;
  const double* head_from_eyes;
  const int64_t *torso, *head, *replaced;                // [4], [5], [2, 33]
  const int64_t *bend_numbers, *bend_hub;                // [bends, 3], [bends]
  const double* bend_axes;                               // [bends, 3, 3]
  const int64_t *limb_hub, *limb_points, *limb_numbers;  // [limbs], [limbs, 3], [limbs, 4]
  const double *limb_axes, *limb_bend;                   // [limbs, 3, 3], [limbs]
  // of body/fingers.py: buffers of Fingers, and its steps by round
  const int64_t *finger_chains, *finger_joints;
  const double *finger_rest, *finger_palms, *finger_bones, *finger_axes, *finger_prior;
  const double *finger_minimum, *finger_maximum;
  const int64_t* finger_steps;
  // the frames
  const void *p, *visibility;    // [B, 33, 3] finite, [B, 33]
  const uint8_t* valid;          // [B, 33]
  const void* hands;             // [B, 42, 3], null where the frames or the body have none
  const uint8_t* seen;           // [B, 42]; those are finite
  void *theta, *transl;          // [B, J, 3], [B, 3]
};
}

namespace gsgan {

constexpr int BODY = 33, L_HIP = 2, R_HIP = 3;  // hips among the torso's points

template <class T> class BodySolver {
 public:
  explicit BodySolver(const SolveJob& job)
      : job(job), D(int(job.D)), goal(job.landmarks), weight(job.landmarks), R(job.T), turned(job.T),
        world(job.T), origin(job.T), turn(job.T), own(job.D), J(job.D), whole(job.J), used(job.J),
        factor(job.D * job.D), first_entry(job.T + 1) {
    for (int64_t e = 0; e < job.E; ++e) ++first_entry[job.entry_turn[e] + 1];
    for (int64_t t = 0; t < job.T; ++t) first_entry[t + 1] += first_entry[t];
    fingers = {job.finger_chains,  job.finger_joints,  job.finger_steps, job.finger_rest,
               job.finger_palms,   job.finger_bones,   job.finger_axes,  job.finger_prior,
               job.finger_minimum, job.finger_maximum, job.finger_noise, job.trace,
               job.rounds,         job.placing};
  }

  void solve(int64_t b) {
    const Vec3 shift = read_frame(b);
    State best = guess();
    descend(best);
    last_step(best);
    const Vec3 moved = shift + read3(&best.q[3]);
    write3(static_cast<T*>(job.transl) + 3 * b, moved);
    write_turns(best, static_cast<T*>(job.theta) + 3 * job.J * b);
  }

 private:
  struct State {
    std::vector<double> q;
    Mat3 root;
    double cost = 0;
    std::vector<double> g, H;  // half the gradient; the lower triangle of Gauss-Newton's matrix
  };

  const SolveJob& job;
  const int D;
  std::vector<Vec3> goal;
  std::vector<double> weight;
  std::vector<Mat3> R, turned, world;  // by turn: its rotation, its derivative, all up to it
  std::vector<Vec3> origin, turn;
  std::vector<int> own;                // the numbers that move a landmark
  std::vector<Vec3> J;                 // and its derivatives by them; zero between landmarks
  std::vector<Mat3> whole;
  std::vector<uint8_t> used;
  std::vector<double> factor;
  std::vector<int64_t> first_entry;
  FingerModel fingers;
  Hands hands;
  int count = BODY;  // landmarks of a frame

  // The frame about the middle of its hips, with the landmarks that place its hands.
  Vec3 read_frame(int64_t b) {
    const T* p = static_cast<const T*>(job.p) + 3 * BODY * b;
    const T* visibility = static_cast<const T*>(job.visibility) + BODY * b;
    const uint8_t* valid = job.valid + BODY * b;
    const int64_t l_hip = job.torso[L_HIP], r_hip = job.torso[R_HIP];
    const Vec3 shift = 0.5 * (read3(p + 3 * l_hip) + read3(p + 3 * r_hip));
    for (int i = 0; i < BODY; ++i) {
      goal[i] = read3(p + 3 * i) - shift;
      weight[i] = 0;
      if (valid[i]) weight[i] = job.precision[i] * std::min(double(visibility[i]), 1.0);
    }
    if (!valid[l_hip] && !valid[r_hip]) weight[l_hip] = weight[r_hip] = 1 / (job.held * job.held);
    if (job.hands) read_hands(b, shift);
    return shift;
  }

  void read_hands(int64_t b, Vec3 shift) {
    count = int(job.landmarks);
    for (int side = 0; side < 2; ++side) {
      const T* p = static_cast<const T*>(job.hands) + 3 * HAND * (2 * b + side);
      const uint8_t* seen = job.seen + HAND * (2 * b + side);
      Vec3 hand[HAND];
      for (int i = 0; i < HAND; ++i) hand[i] = seen[i] ? read3(p + 3 * i) - shift : Vec3{};
      fit_hand(fingers, side, hand, seen, hands);
      const bool placed = hands.placed[side];
      for (int i = 0; placed && i < BODY; ++i)
        if (job.replaced[BODY * side + i]) weight[i] = 0;
      for (int i = BODY + 3 * side; i < BODY + 3 * (side + 1); ++i) {
        goal[i] = hands.R[side] * read3(job.rest + 3 * i) + hands.shift[side];
        weight[i] = placed / (job.noise * job.noise);
      }
    }
  }

  State guess() {
    State at{std::vector<double>(D), {}, 0, std::vector<double>(D), std::vector<double>(D * D)};
    Vec3 torso[4], head[5];
    for (int i = 0; i < 4; ++i) torso[i] = goal[job.torso[i]];
    for (int i = 0; i < 5; ++i) head[i] = goal[job.head[i]];
    const Hubs now = hubs_of(torso, head, read33(job.head_from_eyes));
    Mat3 hubs[3] = {now.pelvis, now.chest, now.head};
    for (int i = 0; i < 3; ++i) hubs[i] = hubs[i] * transposed(read33(job.rest_hubs + 9 * i));
    for (int64_t k = 0; k < job.bends; ++k) {
      const int64_t hub = job.bend_hub[k];
      const Vec3 numbers = read33(job.bend_axes + 9 * k) * log_of(transposed(hubs[hub]) * hubs[hub + 1]);
      const double each[3] = {numbers.x, numbers.y, numbers.z};
      for (int i = 0; i < 3; ++i) at.q[job.bend_numbers[3 * k + i]] = each[i];
    }
    for (int64_t k = 0; k < job.limbs; ++k) guess_limb(k, hubs[job.limb_hub[k]], at.q.data());
    const Vec3 joint = read3(job.joints), hips = 0.5 * (torso[L_HIP] + torso[R_HIP]);
    write3(&at.q[3], hips - joint - hubs[0] * (read3(job.rest_hips) - joint));
    at.root = hubs[0];
    return at;
  }

  void guess_limb(int64_t k, const Mat3& hub, double* q) {
    const int64_t *points = job.limb_points + 3 * k, *numbers = job.limb_numbers + 4 * k;
    const Vec3 first = goal[points[0]], middle = goal[points[1]], end = goal[points[2]];
    const Vec3 upper = normalised(transposed_times(hub, middle - first), 1e-6);
    Vec3 lower = normalised(transposed_times(hub, end - middle), 1e-6);
    const Mat3 axes = read33(job.limb_axes + 9 * k);
    const Vec3 flat = axes.x, along = axes.z, swing = shortest_turn(along, upper);
    lower = transposed_times(rotation_of(swing), lower);
    const Vec3 normal = cross(along, lower);
    const double bend = std::atan2(norm(normal), dot(lower, along));
    const double sure = (bend - job.straight) / (job.sharp - job.straight);
    const double twist = std::atan2(dot(normal, cross(along, flat)), dot(normal, flat));
    q[numbers[0]] = dot(swing, axes.x);
    q[numbers[1]] = dot(swing, axes.y);
    q[numbers[2]] = twist * std::clamp(sure, 0.0, 1.0);
    q[numbers[3]] = bend - job.limb_bend[k];
  }

  // Rotations of the turns, in the world, and where their joints are.
  void move(const State& at) {
    for (int64_t t = 0; t < job.T; ++t) {
      Vec3 v;
      for (int64_t e = first_entry[t]; e < first_entry[t + 1]; ++e)
        v = v + at.q[job.entry_number[e]] * read3(job.entry_axis + 3 * e);
      turn[t] = v;
      R[t] = t == 0 ? rotation_of(v) * at.root : rotation_of(v);
      const Vec3 o = joint_of(t);
      const int64_t parent = job.parent[t];
      const Mat3 before = parent < 0 ? IDENTITY : world[parent];
      origin[t] = parent < 0 ? o + read3(&at.q[3]) : carried(parent, o);
      world[t] = before * R[t];
      turned[t] = before * left_jacobian(v);
    }
  }

  Vec3 joint_of(int64_t t) const { return read3(job.joints + 3 * job.joint[t]); }
  Vec3 carried(int64_t t, Vec3 x) const { return origin[t] + world[t] * (x - joint_of(t)); }

  // Cost, gradient and matrix at the numbers and root of a state.
  void linearise(State& at) {
    move(at);
    at.cost = 0;
    for (int i = 0; i < D; ++i) {
      const double below = std::min(at.q[i] - job.minimum[i], 0.0);
      const double stop = below < 0 ? 1 / (job.beyond * job.beyond) : 0;
      double pull = 0;
      for (int j = 0; j < D; ++j) pull += job.prior[i * D + j] * at.q[j];
      at.cost += pull * at.q[i] + (below < 0 ? stop * below * below : 0);
      at.g[i] = pull + (below < 0 ? stop * below : 0);
      for (int j = 0; j <= i; ++j) at.H[i * D + j] = job.prior[i * D + j];
      at.H[i * D + i] += stop + job.floor;
    }
    for (int n = 0; n < count; ++n)
      if (weight[n] > 0) add_landmark(at, n);
  }

  void add_landmark(State& at, int n) {
    const Vec3 x = carried(job.carrier[n], read3(job.rest + 3 * n)), r = x - goal[n];
    const double root = std::sqrt(1 + weight[n] * square(r) / (job.robust * job.robust));
    const double w = weight[n] / root;
    at.cost += 2 * job.robust * job.robust * (root - 1);
    own.clear();
    for (int64_t t = job.carrier[n]; t >= 0; t = job.parent[t])
      for (int64_t e = first_entry[t]; e < first_entry[t + 1]; ++e) {
        const int d = int(job.entry_number[e]);
        if (std::find(own.begin(), own.end(), d) == own.end()) own.push_back(d);
        J[d] = J[d] + cross(turned[t] * read3(job.entry_axis + 3 * e), x - origin[t]);
      }
    for (int k = 0; k < 3; ++k) own.push_back(3 + k);
    J[3] = IDENTITY.x, J[4] = IDENTITY.y, J[5] = IDENTITY.z;
    std::sort(own.begin(), own.end());
    for (size_t i = 0; i < own.size(); ++i) {
      const Vec3 weighted = w * J[own[i]];
      at.g[own[i]] += dot(weighted, r);
      double* row = &at.H[own[i] * D];
      for (size_t j = 0; j <= i; ++j) row[own[j]] += dot(weighted, J[own[j]]);
    }
    for (int d : own) J[d] = {};
  }

  // Levenberg-Marquardt steps; one that raises the cost is undone.
  void descend(State& best) {
    linearise(best);
    State next = best;
    std::vector<double> step(D);
    double damping = job.damping;
    for (int64_t k = 0; k < job.steps; ++k) {
      factor = best.H;
      for (int i = 0; i < D; ++i) factor[i * D + i] *= 1 + damping;
      if (!solve_spd(D, factor.data(), best.g.data(), step.data())) return;
      for (int i = 0; i < D; ++i) next.q[i] = best.q[i] - step[i];
      next.root = rotation_of(read3(next.q.data())) * best.root;  // the next starts from no turn
      for (int i = 0; i < 3; ++i) next.q[i] = 0;
      linearise(next);
      const double cost = best.cost;
      const bool better = next.cost < cost;
      if (better) std::swap(best, next);
      damping *= better ? job.easier : job.harder;
      if (std::abs((better ? best : next).cost - cost) <= job.converged * cost) return;
    }
  }

  void last_step(State& at) {
    std::vector<double> step(D);
    if (!solve_spd(D, at.H.data(), at.g.data(), step.data())) return;
    for (int i = 0; i < D; ++i) at.q[i] -= step[i];
  }

  void write_turns(const State& at, T* theta) {
    move(at);
    std::fill(used.begin(), used.end(), uint8_t(0));
    for (int64_t t = 0; t < job.T; ++t) {
      const int64_t joint = job.joint[t];
      whole[joint] = used[joint] ? whole[joint] * R[t] : R[t];
      used[joint] = 1;
    }
    for (int64_t j = 0; j < job.J; ++j) write3(theta + 3 * j, used[j] ? log_of(whole[j]) : Vec3{});
    for (int k = 0; job.hands && k < 4 * FINGERS; ++k)
      if (hands.shown[k]) write3(theta + 3 * fingers.joints[k], hands.turns[k]);
  }
};

template <class T> int solve(const SolveJob& job) {
#pragma omp parallel num_threads(int(std::max<int64_t>(1, std::min(job.threads, job.B))))
  {
    BodySolver<T> solver(job);
#pragma omp for schedule(dynamic, 1)
    for (int64_t b = 0; b < job.B; ++b) solver.solve(b);
  }
  return 0;
}

}  // namespace gsgan
