// Fingers and positions of hands from their landmarks, one frame at a time, in double. Definitions:
// body/fingers.py, whose tensor operations are the reference.
#pragma once

#include <cstdint>

#include "turns.h"

namespace gsgan {

constexpr int HAND = 21, FINGERS = 5, NUMBERS = 5, PALM[3] = {0, 5, 17};
constexpr double NO_BONE = 1e-9;  // metres: a shorter one has no direction

// Of body/fingers.py, arrays as the buffers of Fingers; noise and trace are its constants.
struct FingerModel {
  const int64_t *chains, *joints, *steps;  // [10, 4], [20], [rounds]
  const double *rest, *palms, *bones, *axes, *prior, *minimum, *maximum;
  double noise, trace;
  int64_t rounds, placing;
};

struct Hands {
  Vec3 turns[4 * FINGERS];  // of the first joints, then of the second
  bool shown[4 * FINGERS], placed[2];
  Mat3 R[2];
  Vec3 shift[2];
};

struct Finger {
  Vec3 bones[3], axes[NUMBERS];
  double numbers[NUMBERS];

  Vec3 first() const {
    return numbers[0] * axes[0] + numbers[1] * axes[1] + numbers[2] * axes[2];
  }
  Vec3 second() const { return numbers[3] * axes[3] + numbers[4] * axes[4]; }
};

inline void start_finger(Finger& f, const Vec3 now[3], const double weight[3]) {
  Mat3 before = IDENTITY;
  for (int part = 0; part < 2; ++part) {
    Vec3 from, to;
    for (int k = part; k < 1 + 2 * part; ++k)
      if (weight[k] > 0) from = from + f.bones[k], to = to + now[k];
    const Vec3 turn = shortest_turn(normalised(from, NO_BONE),
                                    normalised(transposed_times(before, to), NO_BONE));
    for (int k = 3 * part; k < 3 + 2 * part; ++k) f.numbers[k] = dot(f.axes[k], turn);
    before = rotation_of(f.first());
  }
}

inline void step_finger(Finger& f, const Vec3 now[3], const double weight[3], const double* prior) {
  const Vec3 turns[2] = {f.first(), f.second()};
  const Mat3 first = rotation_of(turns[0]), both = first * rotation_of(turns[1]);
  const Mat3 moved[2] = {left_jacobian(turns[0]), first * left_jacobian(turns[1])};
  const Vec3 middle = first * f.bones[0];
  double H[NUMBERS * NUMBERS] = {}, g[NUMBERS], x[NUMBERS];
  for (int i = 0; i < NUMBERS; ++i) {
    H[i * NUMBERS + i] = prior[i];
    g[i] = prior[i] * f.numbers[i];
  }
  for (int k = 0; k < 3; ++k) {
    const Vec3 beyond = k == 0 ? Vec3{} : both * f.bones[k];
    const Vec3 r = middle + beyond - now[0] - (k == 0 ? Vec3{} : now[k]);
    Vec3 J[NUMBERS];
    for (int i = 0; i < NUMBERS; ++i)
      J[i] = cross(moved[i >= 3] * f.axes[i], i < 3 ? middle + beyond : beyond);
    for (int i = 0; i < NUMBERS; ++i) {
      g[i] += weight[k] * dot(J[i], r);
      for (int j = 0; j <= i; ++j) H[i * NUMBERS + j] += weight[k] * dot(J[i], J[j]);
    }
  }
  if (solve_spd(NUMBERS, H, g, x))
    for (int i = 0; i < NUMBERS; ++i) f.numbers[i] -= x[i];
}

// The motion of x nearest to the landmarks seen, from R.
inline void place_hand(const FingerModel& m, const Vec3* x, const Vec3* hand, const uint8_t* seen,
                       Mat3& R, Vec3& shift) {
  double count = 0;
  Vec3 centre, goal;
  for (int i = 0; i < HAND; ++i)
    if (seen[i]) count += 1, centre = centre + x[i], goal = goal + hand[i];
  const double share = 1 / std::max(count, 1.0);
  centre = share * centre, goal = share * goal;
  for (int64_t step = 0; step < m.placing; ++step) {
    Mat3 S{};
    Vec3 slope, turn;
    for (int i = 0; i < HAND; ++i) {
      if (!seen[i]) continue;
      const Vec3 now = R * (x[i] - centre);
      add_outer(S, share * now, now);
      slope = slope + share * cross(now, hand[i] - goal);
    }
    const double trace = S.x.x + S.y.y + S.z.z + SHORT * SHORT;
    const Mat3 H = trace * IDENTITY + -1.0 * S;
    double lower[9] = {H.x.x, 0, 0, H.y.x, H.y.y, 0, H.z.x, H.z.y, H.z.z};
    if (solve_spd(3, lower, &slope.x, &turn.x)) R = rotation_of(turn) * R;
  }
  shift = goal - R * centre;
}

// One hand of a frame: its landmarks, finite, and whether each is seen.
inline void fit_hand(const FingerModel& m, int side, const Vec3* hand, const uint8_t* seen,
                     Hands& out) {
  const Vec3 wrist = hand[PALM[0]], index = hand[PALM[1]], pinky = hand[PALM[2]];
  Mat3& R = out.R[side];
  R = palm_frame(wrist, index, pinky) * transposed(read33(m.palms + 9 * side));
  out.placed[side] = seen[PALM[0]] && seen[PALM[1]] && seen[PALM[2]];
  for (int64_t round = 0; round < m.rounds; ++round) {
    Vec3 x[HAND];
    for (int i = 0; i < HAND; ++i) x[i] = read3(m.rest + 3 * (side * HAND + i));
    for (int k = side * FINGERS; k < (side + 1) * FINGERS; ++k) {
      Finger f;
      int chain[4];
      for (int i = 0; i < 4; ++i) chain[i] = int(m.chains[4 * k + i]) - side * HAND;
      for (int i = 0; i < NUMBERS; ++i) f.axes[i] = read3(m.axes + 3 * (NUMBERS * k + i)), f.numbers[i] = 0;
      Vec3 now[3];
      double weight[3];
      for (int i = 0; i < 3; ++i) {
        f.bones[i] = read3(m.bones + 9 * k + 3 * i);
        const Vec3 bone = hand[chain[i + 1]] - hand[chain[i == 0 ? 0 : 1]];
        now[i] = normalised(transposed_times(R, bone) + m.trace * f.bones[i], NO_BONE);
        now[i] = norm(f.bones[i]) * now[i];
        weight[i] = seen[chain[i + 1]] / (m.noise * m.noise);
      }
      start_finger(f, now, weight);
      for (int64_t step = 0; step <= m.steps[round]; ++step) {
        if (step > 0) step_finger(f, now, weight, m.prior + NUMBERS * k);
        for (int i = 0; i < NUMBERS; ++i) {
          const int at = NUMBERS * k + i;
          f.numbers[i] = std::min(std::max(f.numbers[i], m.minimum[at]), m.maximum[at]);
        }
      }
      out.turns[k] = f.first(), out.turns[2 * FINGERS + k] = f.second();
      const Mat3 first = rotation_of(f.first()), both = first * rotation_of(f.second());
      x[chain[1]] = x[chain[0]] + first * f.bones[0];
      for (int i = 1; i < 3; ++i) x[chain[i + 1]] = x[chain[1]] + both * f.bones[i];
      out.shown[k] = seen[chain[0]] && seen[chain[1]] && out.placed[side];
      out.shown[2 * FINGERS + k] = out.shown[k] && (seen[chain[2]] || seen[chain[3]]);
    }
    place_hand(m, x, hand, seen, R, out.shift[side]);
  }
}

}  // namespace gsgan
