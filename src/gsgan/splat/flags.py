"""The compiler's flags for the kernels: for `gsgan.splat.build`, and for wheels that carry them."""

# No -ffast-math: NaN and infinity keep their meaning, sums keep their order.
BASE_FLAGS = (
    "-std=c++17",
    "-O3",
    "-fPIC",
    "-shared",
    "-fopenmp-simd",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=fast",
)
# Further flags of a wheel's kernels, by machine: x86-64 processors need AVX2 and FMA.
WHEEL_FLAGS = {
    "x86_64": ("-march=x86-64-v3", "-fopenmp"),
    "aarch64": ("-march=armv8-a", "-fopenmp"),
}
