// Rotations of a body's joints and the frames of a skeleton's trunk and head, in double. Definitions:
// body/lbs.py, skeleton/frames.py, skeleton/rotation6d.py, whose tensor operations are the reference.
#pragma once

#include <algorithm>
#include <cmath>

#include "ewa.h"

namespace gsgan {

constexpr double MIN_LENGTH = 1e-3, FOLDED = 1e-4;  // of skeleton/frames.py, skeleton/tensors.py
constexpr double SHORT = 1e-3;                      // of skeleton/hands.py
constexpr double COLUMN_MIN = 1e-5;                 // of rotation_from_6d
constexpr Mat3 IDENTITY{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};

inline double square(Vec3 a) { return dot(a, a); }
inline double norm(Vec3 a) { return std::sqrt(dot(a, a)); }
inline Vec3 normalised(Vec3 a, double eps) { return (1 / std::max(norm(a), eps)) * a; }
inline Vec3 unit(Vec3 a) { return (1 / norm(a)) * a; }
inline Vec3 across(Vec3 axis, Vec3 v) { return v - dot(axis, v) * axis; }

inline Mat3 transposed(const Mat3& m) {
  return {{m.x.x, m.y.x, m.z.x}, {m.x.y, m.y.y, m.z.y}, {m.x.z, m.y.z, m.z.z}};
}
inline Mat3 columns(Vec3 a, Vec3 b, Vec3 c) { return transposed({a, b, c}); }
inline Mat3 operator*(const Mat3& a, const Mat3& b) {
  return {transposed_times(b, a.x), transposed_times(b, a.y), transposed_times(b, a.z)};
}
inline Mat3 operator+(const Mat3& a, const Mat3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Mat3 operator*(double s, const Mat3& m) { return {s * m.x, s * m.y, s * m.z}; }

// I + a K + b K K, where K v is the cross product with v.
inline Mat3 series(Vec3 v, double a, double b) {
  const double s = square(v);
  Mat3 m{{1 - b * s, -a * v.z, a * v.y}, {a * v.z, 1 - b * s, -a * v.x}, {-a * v.y, a * v.x, 1 - b * s}};
  add_outer(m, b * v, v);
  return m;
}

inline Mat3 rotation_of(Vec3 v) {  // axis_angle_to_matrix
  const double s = square(v), angle = std::sqrt(s);
  if (s < 1e-6) return series(v, 1 - s / 6, 0.5 - s / 24);
  const double half = std::sin(angle / 2) / angle;
  return series(v, std::sin(angle) / angle, 2 * half * half);
}

inline Mat3 left_jacobian(Vec3 v) {
  const double s = square(v), angle = std::sqrt(s);
  if (s < 1e-4) return series(v, 0.5 - s / 24, 1.0 / 6 - s / 120);
  return series(v, (1 - std::cos(angle)) / s, (angle - std::sin(angle)) / (s * angle));
}

inline Vec3 shortest_turn(Vec3 a, Vec3 b) {
  const Vec3 axis = cross(a, b);
  const double sine = norm(axis);
  return (std::atan2(sine, dot(a, b)) / std::max(sine, 1e-6)) * axis;
}

inline Vec3 log_of(const Mat3& m) {  // axis-angle, by the quaternion's largest component
  const double trace = m.x.x + m.y.y + m.z.z;
  const Vec3 odd{m.z.y - m.y.z, m.x.z - m.z.x, m.y.x - m.x.y};
  double w;
  Vec3 v;
  if (trace > 0) {
    w = 1 + trace, v = odd;
  } else if (m.x.x > m.y.y && m.x.x > m.z.z) {
    w = odd.x, v = {1 + m.x.x - m.y.y - m.z.z, m.x.y + m.y.x, m.x.z + m.z.x};
  } else if (m.y.y > m.z.z) {
    w = odd.y, v = {m.x.y + m.y.x, 1 + m.y.y - m.x.x - m.z.z, m.y.z + m.z.y};
  } else {
    w = odd.z, v = {m.x.z + m.z.x, m.y.z + m.z.y, 1 + m.z.z - m.x.x - m.y.y};
  }
  const double sine = norm(v);
  if (sine == 0) return {};
  return (2 * (w < 0 ? std::atan2(-sine, -w) : std::atan2(sine, w)) / sine) * v;
}

// ---------------------------------------------------------------------- frames of trunk and head

inline Vec3 faded(Vec3 v, Vec3 fallback) {
  v = (1 / MIN_LENGTH) * v;
  v = v + std::max(1 - square(v), 0.0) * fallback;
  return unit(square(v) < FOLDED ? fallback : v);
}

inline Vec3 shortened(Vec3 v) { return (1 / std::max(norm(v), MIN_LENGTH)) * v; }
inline double whole(Vec3 v) { return std::min(square(v) / (MIN_LENGTH * MIN_LENGTH), 1.0); }

inline Vec3 least_axis(Vec3 v) {
  const double x = std::abs(v.x), y = std::abs(v.y), z = std::abs(v.z);
  return x <= y && x <= z ? IDENTITY.x : y <= z ? IDENTITY.y : IDENTITY.z;
}

inline Mat3 orthonormal(Vec3 a, Vec3 b) {  // rotation_from_6d
  const Vec3 first = unit(norm(a) < COLUMN_MIN ? IDENTITY.x : a), part = across(first, b);
  const bool lost = norm(part) < COLUMN_MIN * std::max(norm(b), 1.0);
  const Vec3 second = unit(lost ? across(first, least_axis(first)) : part);
  const Vec3 again = unit(across(first, second));
  return columns(first, again, cross(first, again));
}

struct Hubs {
  Mat3 pelvis, chest, head;
};

// Of shoulders and hips, left first; and of left ear, right ear, left eye, right eye and nose.
inline Hubs hubs_of(const Vec3 torso[4], const Vec3 points[5], const Mat3& head_from_eyes) {
  const Vec3 up = faded(0.5 * (torso[0] + torso[1] - torso[2] - torso[3]), IDENTITY.y);
  const Vec3 shoulders = across(up, torso[0] - torso[1]), hips = across(up, torso[2] - torso[3]);
  const Vec3 stray = unit(across(up, std::abs(up.x) < 0.9 ? IDENTITY.x : least_axis(up)));
  const Vec3 low = unit(across(up, faded(hips, faded(shoulders, stray))));
  const Vec3 high = unit(across(up, faded(shoulders, faded(hips, stray))));
  const Mat3 chest = columns(high, up, cross(high, up));
  Mat3 frames[2];
  double share[2];
  for (int k = 0; k < 2; ++k) {  // of ears, of eyes
    const Vec3 a = points[2 * k], b = points[2 * k + 1], left = shortened(a - b);
    const Vec3 line = across(left, points[4] - 0.5 * (a + b)), front = shortened(line);
    frames[k] = columns(left, cross(front, left), front);
    share[k] = whole(a - b) * whole(line);
  }
  const Mat3 eyes = share[1] * (frames[1] * head_from_eyes) + (1 - share[1]) * chest;
  const Mat3 mixed = transposed(share[0] * frames[0] + (1 - share[0]) * eyes);
  return {columns(low, up, cross(low, up)), chest, orthonormal(mixed.x, mixed.y)};
}

inline Mat3 palm_frame(Vec3 wrist, Vec3 index, Vec3 pinky) {
  const Vec3 along = normalised(0.5 * (index + pinky) - wrist, SHORT);
  const Vec3 side = normalised(across(along, index - pinky), SHORT);
  return columns(along, side, cross(along, side));
}

// ------------------------------------------------------------------------------------ small systems

// x = H^-1 g for the positive definite n x n H, whose lower triangle becomes its factor; false where
// H is not positive definite.
inline bool solve_spd(int n, double* H, const double* g, double* x) {
  for (int i = 0; i < n; ++i) {
    double* row = H + i * n;
    for (int j = 0; j <= i; ++j) {
      const double* other = H + j * n;
      double sum = row[j];
      for (int k = 0; k < j; ++k) sum -= row[k] * other[k];
      if (j < i) {
        row[j] = sum / other[j];
      } else if (sum > 0) {
        row[i] = std::sqrt(sum);
      } else {
        return false;
      }
    }
  }
  for (int i = 0; i < n; ++i) {
    x[i] = g[i];
    for (int k = 0; k < i; ++k) x[i] -= H[i * n + k] * x[k];
    x[i] /= H[i * n + i];
  }
  for (int i = n - 1; i >= 0; --i) {
    x[i] /= H[i * n + i];
    for (int k = 0; k < i; ++k) x[k] -= H[i * n + k] * x[i];
  }
  return true;
}

}  // namespace gsgan
