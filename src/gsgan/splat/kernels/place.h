// An ellipse relative to a nearby point, where its q is a sum of small numbers; and the minimum of
// q over a rectangle of pixel centres.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "job.h"

namespace gsgan {

// Pixels by which footprints are enlarged where tiles and cells are listed, in addition to rounding
// errors: costs time, changes no pixel.
constexpr double PAD = 1e-3;

// u and v at an origin; at the offset (x, y) they are u + p x + w y and v + r y.
template <class T> struct Place {
  T u, v, p, w, r;
  T dx, dy;  // of the origin from the mean
};

// u and v this large are far beyond every cut-off; their squares do not overflow.
template <class T> constexpr double U_MAX = sizeof(T) == 4 ? 1e15 : 1e150;

template <class T, class E> Place<T> place_at(const E& g, double x, double y) {
  const double dx = x - g.mx, dy = y - g.my, p = g.p, r = g.r;
  const double u = std::clamp(p * (dx + g.k * dy), -U_MAX<T>, U_MAX<T>);
  const double v = std::clamp(r * dy, -U_MAX<T>, U_MAX<T>);
  return {T(u), T(v), T(p), T(p * g.k), T(r), T(dx), T(dy)};
}

template <class T> T between(T x, T low, T high) { return x < low ? low : (x > high ? high : x); }

// The minimum of u^2 + v^2 over rectangles about the origin of a place. It is convex: the minimum
// is on an edge that faces the mean, and has a closed form along an edge.
template <class T> struct Least {
  Place<T> at;
  T per_p, per_ww_rr;  // 1 / p, 1 / (w^2 + r^2)

  explicit Least(const Place<T>& place)
      : at(place), per_p(1 / place.p), per_ww_rr(1 / (place.w * place.w + place.r * place.r)) {}

  T operator()(T x0, T x1, T y0, T y1) const {
    const T x = between(-at.dx, x0, x1), y = between(-at.dy, y0, y1);
    const T u_x = at.u + at.p * x, u_y = at.u + at.w * y;
    const T best_y = between(-(at.w * u_x + at.r * at.v) * per_ww_rr, y0, y1);
    const T best_x = between(-u_y * per_p, x0, x1);
    const T ua = u_x + at.w * best_y, va = at.v + at.r * best_y;
    const T ub = u_y + at.p * best_x, vb = at.v + at.r * y;
    const T a = ua * ua + va * va, b = ub * ub + vb * vb;
    return a < b ? a : b;
  }

  // Bound of the rounding error, for rectangles within `half` of the origin.
  T margin(T half) const {
    const T size = at.u * at.u + at.v * at.v +
                   half * half * (at.p * at.p + at.w * at.w + at.r * at.r);
    return 32 * std::numeric_limits<T>::epsilon() * size;
  }
};

}  // namespace gsgan
