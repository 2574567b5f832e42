// One SIMD register: loads, sums, and the exponential, with gcc's and clang's vector extensions.
#pragma once

#include <cstdint>
#include <type_traits>
#include <utility>

#if defined(__AVX512F__)
#define SIMD_BYTES 64
#elif defined(__AVX__)
#define SIMD_BYTES 32
#else
#define SIMD_BYTES 16
#endif
#define INLINE inline __attribute__((always_inline))

namespace gsgan {

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

template <class T> INLINE Vec<T> load(const T* p) { return *reinterpret_cast<const Vec<T>*>(p); }
template <class T> INLINE void store(T* p, Vec<T> v) { *reinterpret_cast<Vec<T>*>(p) = v; }
template <class T> INLINE Vec<T> splat(T x) { return Vec<T>{} + x; }
template <class V> INLINE V magnitude(V v) { return v < V{} ? -v : v; }

// Selects lanes of two registers.
#if defined(__clang__) || __GNUC__ >= 12
template <class T, int... L> INLINE Vec<T> lanes(Vec<T> a, Vec<T> b) {
  return __builtin_shufflevector(a, b, L...);
}
#else
template <class T, int... L> INLINE Vec<T> lanes(Vec<T> a, Vec<T> b) {
  return __builtin_shuffle(a, b, typename Simd<T>::I{L...});
}
#endif

// Halves blocks of S lanes: adds lanes i and i + S / 2 of each block. The first half of the result
// comes from a, the second from b.
template <class T, int S, int... I>
INLINE Vec<T> folded(Vec<T> a, Vec<T> b, std::integer_sequence<int, I...>) {
  constexpr int H = S / 2;
  return lanes<T, (I / H * S + I % H)...>(a, b) + lanes<T, (I / H * S + I % H + H)...>(a, b);
}
template <class T, int S> INLINE Vec<T> folded(Vec<T> a, Vec<T> b) {
  return folded<T, S>(a, b, std::make_integer_sequence<int, Simd<T>::W>());
}

// Sums over the lanes of each of G registers; together, because one at a time would take longer
// than computing the summands.
template <class T, int G, int S = Simd<T>::W> INLINE void sums(Vec<T>* v, T* out) {
  constexpr int W = Simd<T>::W;
  if constexpr (S == 1) {
    alignas(64) T t[W];
    for (int first = 0; first < G; first += W) {
      store(t, v[first / W]);
      for (int g = first; g < G && g < first + W; ++g) out[g] = t[g - first];
    }
  } else {
    // An odd last register is folded with itself: its second half is not read.
    constexpr int REGISTERS = (G * S + W - 1) / W, LEFT = (REGISTERS + 1) / 2;
    for (int i = 0; i < LEFT; ++i)
      v[i] = folded<T, S>(v[2 * i], v[2 * i + 1 < REGISTERS ? 2 * i + 1 : 2 * i]);
    sums<T, G, S / 2>(v, out);
  }
}

template <class T> INLINE bool any_at_least(Vec<T> v, T bound) {
  constexpr int W = Simd<T>::W;
  alignas(64) T t[W];
  store(t, v);
  int found = 0;
  for (int i = 0; i < W; ++i) found |= t[i] >= bound;
  return found != 0;
}

// 2^x = 2^n 2^r, |r| <= 1/2, by the Taylor series of 2^r: within 2 ulp for x in [LOW, 0].
// Below LOW it is 0 (a weight under 3e-38, or 5e-308 in double).
template <class T> struct Exp2;
template <> struct Exp2<float> {
  static constexpr float LOW = -125.0f, MAGIC = 12582912.0f;  // 1.5 * 2^23
  static constexpr int TERMS = 7, MANTISSA = 23;
};
template <> struct Exp2<double> {
  static constexpr double LOW = -1021.0, MAGIC = 6755399441055744.0;  // 1.5 * 2^52
  static constexpr int TERMS = 13, MANTISSA = 52;
};

// ln(2)^k / k!
constexpr double EXP2_SERIES[] = {1.0,
                                  0.69314718055994530942,
                                  0.24022650695910071233,
                                  0.055504108664821579953,
                                  0.0096181291076284771620,
                                  0.0013333558146428443423,
                                  0.00015403530393381609954,
                                  1.5252733804059840280e-05,
                                  1.3215486790144309488e-06,
                                  1.0178086009239699727e-07,
                                  7.0549116208011233299e-09,
                                  4.4455382718708114976e-10,
                                  2.5678435993488205142e-11,
                                  1.3691488853904128881e-12};

template <class T> INLINE Vec<T> exp2_of_negative(Vec<T> x) {
  using E = Exp2<T>;
  using V = Vec<T>;
  using I = typename Simd<T>::I;
  const V low = splat<T>(E::LOW), zero = splat<T>(0);
  const V y = x < low ? low : x;
  const V shifted = y + E::MAGIC;  // the integer n sits in the low bits
  const V r = y - (shifted - E::MAGIC);
  V p = splat<T>(T(EXP2_SERIES[E::TERMS]));
#pragma GCC unroll 16
  for (int k = E::TERMS - 1; k >= 0; --k) p = p * r + T(EXP2_SERIES[k]);
  const V scaled = reinterpret_cast<V>(reinterpret_cast<I>(p) +
                                       (reinterpret_cast<I>(shifted) << E::MANTISSA));
  return x < low ? zero : scaled;
}

}  // namespace gsgan
