// The avatar's Gaussians in a pose, and as ellipses on an image: what gsgan.model.harmonic and
// gsgan.splat.project compute, for one pose and one camera.
import type { Content, Header } from "./content";

/** A pinhole camera in OpenCV's axes: x right, y down, z forward; matrices row by row. */
export interface Camera {
  K: ArrayLike<number>; // 3 x 3, pixels; the centre of the first pixel is at 0.5
  R: ArrayLike<number>; // 3 x 3, world to camera
  t: ArrayLike<number>; // metres
  width: number;
  height: number;
}

export const FLOATS = 12; // of an ellipse: centre 2, opacity, factor 3, colour 3, unused 3
export const ROW = 256; // ellipses in a row of the texture that takes them
const HARMONICS = 9;
const BEFORE_COLOUR = 11; // numbers of a Gaussian: mean 3, quaternion 4, scale 3, opacity, colour
const NORMAL_FLOOR = 1e-2; // of gsgan.model.body_points
const BINS = 1 << 16;
const C0 = Math.sqrt(1 / (4 * Math.PI)), C1 = Math.sqrt(3 / (4 * Math.PI));
const C2 = [15 / 4, 5 / 16, 15 / 16].map((k) => Math.sqrt(k / Math.PI)) as [number, number, number];
const C3 = [35 / 32, 105 / 4, 21 / 32, 7 / 16, 105 / 16].map((k) => Math.sqrt(k / Math.PI)) as
  [number, number, number, number, number];

export class Gaussians {
  readonly ellipses: Float32Array; // back to front
  private readonly h: Header;
  private readonly bone: Uint8Array;
  private readonly weight: Float32Array;
  private readonly slopeBone: Uint8Array; // [N, slopes]
  private readonly slope: Float32Array; // [N, slopes, 3] gradients of skinning weights
  private readonly pulled = new Float64Array(9); // what they add to one point's frame
  private readonly rest: Float32Array;
  private readonly normal: Float32Array;
  private readonly first: Float32Array; // [N, numbers] of the first harmonic
  private readonly others: Float32Array; // [N, numbers that follow, 8]
  private readonly numbers: number;
  private readonly axes: Float32Array; // [N, 9] in the part's frame, scaled
  private readonly turn: Float32Array; // [N, 9] linear part of the skinning
  private readonly mean: Float32Array;
  private readonly covariance: Float32Array; // [N, 6] xx xy xz yy yz zz
  private readonly opacity: Float32Array;
  private readonly colour: Float32Array; // [N, 3 (d+1)²]
  private readonly flat: Float32Array; // ellipses in the order of the Gaussians
  private readonly depth: Float32Array;
  private readonly shown: Uint32Array;
  private readonly starts = new Uint32Array(BINS + 1);

  constructor(content: Content) {
    const h = (this.h = content.header), N = h.count;
    this.numbers = BEFORE_COLOUR + 3 * (h.degree + 1) ** 2;
    this.bone = content.array("bone", "u1");
    this.weight = Float32Array.from(content.array("weight", "u2"), (w) => w / 65535);
    this.slopeBone = content.array("slopeBone", "u1");
    this.slope = Float32Array.from(content.array("slope", "i2"), (x) => h.slopeStep * x);
    const [least, step] = h.range;
    this.rest = Float32Array.from(content.array("mean", "u2"), (x) => least + step * x);
    this.normal = Float32Array.from(content.array("normal", "i2"), (x) => x / 32767);
    const first = content.array("first", "i2"), others = content.array("others", "i1");
    const steps = content.array("steps", "f4"), C = this.numbers, rows = (HARMONICS - 1) * h.follow.length;
    this.first = new Float32Array(C * N);
    this.others = new Float32Array(rows * N);
    for (let c = 0; c < C; ++c)
      for (let i = 0; i < N; ++i) this.first[i * C + c] = steps[c]! * first[c * N + i]!;
    for (let k = 0; k < rows; ++k)
      for (let i = 0; i < N; ++i) this.others[i * rows + k] = steps[C + k]! * others[k * N + i]!;
    this.axes = new Float32Array(9 * N);
    for (let i = 0; i < N; ++i) this.shape(i, this.first.subarray(i * C, (i + 1) * C));
    this.turn = new Float32Array(9 * N);
    this.mean = new Float32Array(3 * N);
    this.covariance = new Float32Array(6 * N);
    this.opacity = new Float32Array(N);
    this.colour = new Float32Array((this.numbers - BEFORE_COLOUR) * N);
    this.flat = new Float32Array(FLOATS * N);
    this.ellipses = new Float32Array(FLOATS * ROW * Math.ceil(N / ROW));
    this.depth = new Float32Array(N);
    this.shown = new Uint32Array(N);
  }

  /** Moves the Gaussians with bones [J, 12], the rows of A then t. */
  pose(bones: ArrayLike<number>): void {
    const { h, bone, weight, rest, normal, first, others, numbers, turn, mean } = this;
    const K = h.weights, raw = new Float32Array(numbers), b = new Float64Array(HARMONICS - 1);
    const A = new Float64Array(9), s3 = Math.sqrt(3), s5 = Math.sqrt(5), s15 = Math.sqrt(15);
    const shapes = h.follow.some((c) => c >= 3 && c < 10);
    for (let i = 0; i < h.count; ++i) {
      let a = 0, d = 0, g = 0, j = 0, e = 0, o = 0, p = 0, q = 0, r = 0, tx = 0, ty = 0, tz = 0;
      for (let k = 0; k < K; ++k) {
        const s = weight[K * i + k]!, at = 12 * bone[K * i + k]!;
        if (s === 0) continue;
        a += s * bones[at]!, d += s * bones[at + 1]!, g += s * bones[at + 2]!;
        j += s * bones[at + 3]!, e += s * bones[at + 4]!, o += s * bones[at + 5]!;
        p += s * bones[at + 6]!, q += s * bones[at + 7]!, r += s * bones[at + 8]!;
        tx += s * bones[at + 9]!, ty += s * bones[at + 10]!, tz += s * bones[at + 11]!;
      }
      A[0] = a, A[1] = d, A[2] = g, A[3] = j, A[4] = e, A[5] = o, A[6] = p, A[7] = q, A[8] = r;
      turn.set(A, 9 * i);
      this.stretch(i, A, bones);
      // the normal, by the cofactors of the stretched A
      const nx = normal[3 * i]!, ny = normal[3 * i + 1]!, nz = normal[3 * i + 2]!;
      const m0 = A[0]!, m1 = A[1]!, m2 = A[2]!, m3 = A[3]!, m4 = A[4]!, m5 = A[5]!;
      const m6 = A[6]!, m7 = A[7]!, m8 = A[8]!;
      let x = (m4 * m8 - m5 * m7) * nx + (m5 * m6 - m3 * m8) * ny + (m3 * m7 - m4 * m6) * nz;
      let y = (m2 * m7 - m1 * m8) * nx + (m0 * m8 - m2 * m6) * ny + (m1 * m6 - m0 * m7) * nz;
      let z = (m1 * m5 - m2 * m4) * nx + (m2 * m3 - m0 * m5) * ny + (m0 * m4 - m1 * m3) * nz;
      const length = 1 / Math.sqrt(x * x + y * y + z * z + NORMAL_FLOOR ** 2);
      x *= length, y *= length, z *= length;
      b[0] = -s3 * y, b[1] = s3 * z, b[2] = -s3 * x;
      b[3] = s15 * x * y, b[4] = -s15 * y * z, b[5] = (s5 / 2) * (2 * z * z - x * x - y * y);
      b[6] = -s15 * x * z, b[7] = (s15 / 2) * (x * x - y * y);
      for (let c = 0; c < numbers; ++c) raw[c] = first[i * numbers + c]!;
      for (let n = 0, at = i * h.follow.length * b.length; n < h.follow.length; ++n) {
        let sum = 0;
        for (let k = 0; k < b.length; ++k) sum += b[k]! * others[at++]!;
        raw[h.follow[n]!]! += sum;
      }
      // mean: on the skinned body, moved in the part's frame
      const u = rest[3 * i]! + this.moved(raw[0]!), v = rest[3 * i + 1]! + this.moved(raw[1]!);
      const w = rest[3 * i + 2]! + this.moved(raw[2]!);
      mean[3 * i] = a * u + d * v + g * w + tx;
      mean[3 * i + 1] = j * u + e * v + o * w + ty;
      mean[3 * i + 2] = p * u + q * v + r * w + tz;
      if (shapes) this.shape(i, raw);
      this.spread(i, A);
      this.opacity[i] = 1 / (1 + Math.exp(-clamp(raw[10]!, -h.logit, h.logit)));
      this.colour.set(raw.subarray(BEFORE_COLOUR), i * (numbers - BEFORE_COLOUR));
    }
  }

  private moved(x: number): number {
    return this.h.bound ? this.h.bound * Math.tanh(x) : this.h.height * x;
  }

  /** Adds the stretch of the surface to A, up to its limit: gsgan.body.lbs.stretch_jacobian. */
  private stretch(i: number, A: Float64Array, bones: ArrayLike<number>): void {
    const { rest, slope, slopeBone, pulled } = this, n = this.h.slopes;
    pulled.fill(0);
    const x = rest[3 * i]!, y = rest[3 * i + 1]!, z = rest[3 * i + 2]!;
    for (let k = n * i; k < n * (i + 1); ++k) {
      const at = 12 * slopeBone[k]!, u = slope[3 * k]!, v = slope[3 * k + 1]!, w = slope[3 * k + 2]!;
      for (let row = 0; row < 3; ++row) {
        const of = at + 3 * row, place = bones[at + 9 + row]! - bones[9 + row]!; // from the root's
        const moved = bones[of]! * x + bones[of + 1]! * y + bones[of + 2]! * z + place;
        pulled[3 * row]! += moved * u, pulled[3 * row + 1]! += moved * v, pulled[3 * row + 2]! += moved * w;
      }
    }
    let squared = 0;
    for (const value of pulled) squared += value * value;
    const limit = this.h.stretch ?? Infinity;
    const share = Math.min(1, limit / Math.sqrt(squared)); // 1 where nothing is pulled
    for (let e = 0; e < 9; ++e) A[e]! += share * pulled[e]!;
  }

  /** R S of the raw quaternion and log scales. */
  private shape(i: number, raw: Float32Array): void {
    let w = raw[3]!, x = raw[4]!, y = raw[5]!, z = raw[6]!;
    const length = 1 / Math.sqrt(w * w + x * x + y * y + z * z + 1e-12), { axes, h } = this;
    w *= length, x *= length, y *= length, z *= length;
    axes.set([
      1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], 9 * i);
    for (let e = 0; e < 9; ++e) axes[9 * i + e]! *= Math.exp(clamp(raw[7 + (e % 3)]!, h.scales[0], h.scales[1]));
  }

  /** The covariance A R S² Rᵀ Aᵀ. */
  private spread(i: number, A: Float64Array): void {
    const { axes, covariance: out } = this, at = 6 * i;
    let xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0;
    for (let k = 9 * i; k < 9 * i + 3; ++k) {
      const a = axes[k]!, b = axes[k + 3]!, c = axes[k + 6]!;
      const u = A[0]! * a + A[1]! * b + A[2]! * c;
      const v = A[3]! * a + A[4]! * b + A[5]! * c;
      const o = A[6]! * a + A[7]! * b + A[8]! * c;
      xx += u * u, xy += u * v, xz += u * o, yy += v * v, yz += v * o, zz += o * o;
    }
    out[at] = xx, out[at + 1] = xy, out[at + 2] = xz;
    out[at + 3] = yy, out[at + 4] = yz, out[at + 5] = zz;
  }

  /**
   * Writes the visible ellipses, back to front, and returns their number.
   *
   * `times` drawn pixels per pixel of the camera: `supersample` of them is what gsgan does; fewer
   * get the low-pass that averaging would have added.
   */
  project({ K, R, t, width, height }: Camera, times: number): number {
    const { h, mean, covariance, flat, shown, depth } = this;
    const [k0, k1, k3, k4] = [K[0]!, K[1]!, K[3]!, K[4]!].map((x) => x * times) as Four;
    const [k2, k5, W, H] = [K[2]!, K[5]!, width, height].map((x) => x * times) as Four;
    const det = k0 * k4 - k1 * k3, own = times / h.supersample, sharp = h.lowPass * own ** 2;
    const low = sharp + (1 - own ** 2) / 12;
    const limit = { x0: Infinity, x1: -Infinity, y0: Infinity, y1: -Infinity };
    for (const [u, v] of [[0, 0], [W, 0], [0, H], [W, H]] as [number, number][]) {
      const x = (k4 * (u - k2) - k1 * (v - k5)) / det, y = (k0 * (v - k5) - k3 * (u - k2)) / det;
      limit.x0 = Math.min(limit.x0, x), limit.x1 = Math.max(limit.x1, x);
      limit.y0 = Math.min(limit.y0, y), limit.y1 = Math.max(limit.y1, y);
    }
    const [x0, x1] = widened(limit.x0, limit.x1, h.fovClamp);
    const [y0, y1] = widened(limit.y0, limit.y1, h.fovClamp);
    const [r0, r1, r2, r3, r4, r5, r6, r7, r8] = Array.from(R) as unknown as Twelve;
    const eye = [0, 1, 2].map((i) => -(R[i]! * t[0]! + R[3 + i]! * t[1]! + R[6 + i]! * t[2]!));
    let count = 0, near = Infinity, far = 0;
    for (let i = 0; i < h.count; ++i) {
      const x = mean[3 * i]!, y = mean[3 * i + 1]!, z = mean[3 * i + 2]!;
      const zc = r6 * x + r7 * y + r8 * z + t[2]!;
      if (!(zc > h.near)) continue;
      const X = (r0 * x + r1 * y + r2 * z + t[0]!) / zc, Y = (r3 * x + r4 * y + r5 * z + t[1]!) / zc;
      const cx = k0 * X + k1 * Y + k2, cy = k3 * X + k4 * Y + k5;
      const xl = clamp(X, x0, x1), yl = clamp(Y, y0, y1);
      const away0 = k0 * xl + k1 * yl, away1 = k3 * xl + k4 * yl;
      const j0 = (k0 * r0 + k1 * r3 - away0 * r6) / zc, j1 = (k0 * r1 + k1 * r4 - away0 * r7) / zc;
      const j2 = (k0 * r2 + k1 * r5 - away0 * r8) / zc, j3 = (k3 * r0 + k4 * r3 - away1 * r6) / zc;
      const j4 = (k3 * r1 + k4 * r4 - away1 * r7) / zc, j5 = (k3 * r2 + k4 * r5 - away1 * r8) / zc;
      const at = 6 * i, xx = covariance[at]!, xy = covariance[at + 1]!, xz = covariance[at + 2]!;
      const yy = covariance[at + 3]!, yz = covariance[at + 4]!, zz = covariance[at + 5]!;
      const u0 = xx * j0 + xy * j1 + xz * j2, u1 = xy * j0 + yy * j1 + yz * j2;
      const u2 = xz * j0 + yz * j1 + zz * j2;
      const a = u0 * j0 + u1 * j1 + u2 * j2, b = u0 * j3 + u1 * j4 + u2 * j5;
      const c = (xx * j3 + xy * j4 + xz * j5) * j3 + (xy * j3 + yy * j4 + yz * j5) * j4 +
        (xz * j3 + yz * j4 + zz * j5) * j5;
      const before = Math.max(a * c - b * b, 0), after = before + low * (a + c) + low * low;
      let opacity = this.opacity[i]!;
      if (h.antialias) opacity *= Math.sqrt(before / after);
      else if (low > sharp) opacity *= Math.sqrt((before + sharp * (a + c) + sharp ** 2) / after);
      if (!(opacity >= h.alphaMin)) continue;
      const reach = Math.sqrt(2 * Math.log(opacity / h.alphaMin));
      const ex = reach * Math.sqrt(a + low), ey = reach * Math.sqrt(c + low);
      if (cx + ex < 0.5 || cy + ey < 0.5 || cx - ex > W - 0.5 || cy - ey > H - 0.5) continue;
      const out = FLOATS * i, l = Math.sqrt(a + low);
      flat[out] = cx, flat[out + 1] = cy, flat[out + 2] = opacity;
      flat[out + 3] = l, flat[out + 4] = b / l, flat[out + 5] = Math.sqrt(after) / l;
      this.paint(i, x - eye[0]!, y - eye[1]!, z - eye[2]!, out + 6);
      depth[i] = zc;
      shown[count++] = i;
      near = Math.min(near, zc), far = Math.max(far, zc);
    }
    this.sort(count, near, far);
    return count;
  }

  /** The colour of a Gaussian along a direction of view, which its part's frame turns back. */
  private paint(i: number, dx: number, dy: number, dz: number, out: number): void {
    const { turn, colour, flat } = this, degree = this.h.degree, A = 9 * i;
    const size = 3 * (degree + 1) ** 2, at = size * i;
    let red = C0 * colour[at]!, green = C0 * colour[at + 1]!, blue = C0 * colour[at + 2]!;
    if (degree > 0) {
      let x = turn[A]! * dx + turn[A + 3]! * dy + turn[A + 6]! * dz;
      let y = turn[A + 1]! * dx + turn[A + 4]! * dy + turn[A + 7]! * dz;
      let z = turn[A + 2]! * dx + turn[A + 5]! * dy + turn[A + 8]! * dz;
      const length = 1 / Math.max(Math.hypot(x, y, z), 1e-12);
      x *= length, y *= length, z *= length;
      const basis = view(x, y, z, degree);
      for (let k = 1; k < basis.length; ++k) {
        const b = basis[k]!;
        red += b * colour[at + 3 * k]!, green += b * colour[at + 3 * k + 1]!;
        blue += b * colour[at + 3 * k + 2]!;
      }
    }
    flat[out] = Math.max(red + 0.5, 0), flat[out + 1] = Math.max(green + 0.5, 0);
    flat[out + 2] = Math.max(blue + 0.5, 0);
  }

  /** Counting sort by depth, the farthest first. */
  private sort(count: number, near: number, far: number): void {
    const { depth, shown, starts, flat, ellipses } = this;
    const scale = (BINS - 1) / Math.max(far - near, 1e-9);
    starts.fill(0);
    for (let n = 0; n < count; ++n) ++starts[((far - depth[shown[n]!]!) * scale | 0) + 1]!;
    for (let k = 0; k < BINS; ++k) starts[k + 1]! += starts[k]!;
    for (let n = count - 1; n >= 0; --n) {
      const i = shown[n]!, place = starts[(far - depth[i]!) * scale | 0]!++;
      for (let e = 0; e < FLOATS; ++e) ellipses[FLOATS * place + e] = flat[FLOATS * i + e]!;
    }
  }
}

type Four = [number, number, number, number];
type Twelve = [...Four, ...Four, ...Four];

function clamp(x: number, low: number, high: number): number {
  return x < low ? low : x > high ? high : x;
}

function widened(low: number, high: number, by: number): [number, number] {
  const middle = (low + high) / 2, half = (by * (high - low)) / 2;
  return [middle - half, middle + half];
}

/** sh_basis of gsgan.splat.sh. */
function view(x: number, y: number, z: number, degree: number): number[] {
  const basis = [C0, -C1 * y, C1 * z, -C1 * x], xx = x * x, yy = y * y, zz = z * z;
  if (degree > 1)
    basis.push(C2[0] * x * y, -C2[0] * y * z, C2[1] * (2 * zz - xx - yy), -C2[0] * x * z, C2[2] * (xx - yy));
  if (degree > 2)
    basis.push(
      -C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, -C3[2] * y * (4 * zz - xx - yy),
      C3[3] * z * (2 * zz - 3 * xx - 3 * yy), -C3[2] * x * (4 * zz - xx - yy), C3[4] * z * (xx - yy),
      -C3[0] * x * (xx - 3 * yy));
  return basis;
}
