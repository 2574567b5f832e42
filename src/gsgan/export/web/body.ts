// The body behind landmarks: the solver of gsgan.body.solve as WebAssembly, and drags as gsgan.view's.
import type { Content } from "./content";
import code from "./solve.wasm";

export type Point = [x: number, y: number, z: number];
/** Landmarks: [x, y, z], {x, y, z, visibility}, or all numbers in a row. */
export type Landmarks = ArrayLike<number> | ArrayLike<ArrayLike<number>> |
  ArrayLike<{ x: number; y: number; z: number; visibility?: number }>;

interface Exports {
  memory: WebAssembly.Memory;
  room(bytes: number): number;
  place(body: number): void;
  solve(body: number, p: number, visibility: number, valid: number, hands: number, seen: number,
        theta: number, transl: number): void;
  move(body: number, theta: number, transl: number, bones: number): void;
}

export const BODY = 33, HAND = 21, ALL = BODY + 2 * HAND;
const TRUNK = [11, 12, 23, 24];
const middle = (p: Point[], a: number, b: number): Point => scaled(add(p[a]!, p[b]!), 0.5);

export class Body {
  private readonly wasm: Exports;
  private readonly at: number;
  private readonly p: number;
  private readonly visibility: number;
  private readonly flags: number;
  private readonly theta: number;
  private readonly transl: number;
  private readonly out: number;
  private readonly joints: number;
  private readonly landmark: Float32Array;
  private readonly carrier: Uint8Array;
  private readonly rest: Point[];

  private constructor(content: Content, wasm: Exports) {
    this.wasm = wasm;
    this.joints = content.header.bones;
    this.landmark = content.array("landmark", "f4");
    this.carrier = content.array("carrier", "u1");
    this.rest = content.header.rest as Point[];
    const job = content.array("body", "u1");
    this.at = wasm.room(job.length);
    this.p = wasm.room(4 * 3 * ALL);
    this.visibility = wasm.room(4 * BODY);
    this.flags = wasm.room(ALL);
    this.theta = wasm.room(4 * 3 * this.joints);
    this.transl = wasm.room(4 * 3);
    this.out = wasm.room(4 * 12 * this.joints);
    new Uint8Array(wasm.memory.buffer, this.at).set(job);
    wasm.place(this.at);
  }

  static async of(content: Content): Promise<Body> {
    const { instance } = await WebAssembly.instantiate(code as BufferSource);
    return new Body(content, instance.exports as unknown as Exports);
  }

  private floats(at: number, count: number): Float32Array<ArrayBuffer> {
    return new Float32Array(this.wasm.memory.buffer as ArrayBuffer, at, count);
  }

  /** Bones [J, 12] of the pose: views of theta [J, 3] and transl [3] are written first. */
  moved(theta: ArrayLike<number>, transl: ArrayLike<number>): Float32Array {
    this.floats(this.theta, 3 * this.joints).set(theta);
    this.floats(this.transl, 3).set(transl);
    return this.bones();
  }

  private bones(): Float32Array {
    this.wasm.move(this.at, this.theta, this.transl, this.out);
    return this.floats(this.out, 12 * this.joints).slice();
  }

  /** The bones of the pose nearest to 75 landmarks, metres in the world; NaN for those not seen. */
  solved(p: Point[], visibility: number[], hands: boolean): Float32Array {
    const flags = new Uint8Array(this.wasm.memory.buffer, this.flags, ALL);
    this.floats(this.p, 3 * ALL).set(p.flat());
    this.floats(this.visibility, BODY).set(visibility.slice(0, BODY));
    for (let i = 0; i < ALL; ++i) flags[i] = visibility[i]! > 0 ? 1 : 0;
    const given = hands ? [this.p + 12 * BODY, this.flags + BODY] as const : [0, 0] as const;
    this.wasm.solve(this.at, this.p, this.visibility, this.flags, ...given, this.theta, this.transl);
    return this.bones();
  }

  /** The body's own 75 landmarks in a pose. */
  landmarks(bones: ArrayLike<number>): Point[] {
    return Array.from(this.carrier, (bone, i) => {
      const x = this.landmark.subarray(3 * i, 3 * i + 3), b = 12 * bone;
      return [0, 1, 2].map((row) => bones[b + 9 + row]! +
        [0, 1, 2].reduce((sum, k) => sum + bones[b + 3 * row + k]! * x[k]!, 0)) as Point;
    });
  }

  /** A person's landmarks with the subject's lengths: directions are kept, hips stay where they are. */
  retargeted(p: Point[]): Point[] {
    const { rest } = this, q = p.map((x) => [...x] as Point);
    const bone = (from: number, to: number) => {
      const length = distance(rest[from]!, rest[to]!);
      q[to] = add(q[from]!, scaled(unit(subtract(p[to]!, p[from]!)), length));
    };
    const pair = (a: number, b: number, centre: Point) => {
      const half = scaled(unit(subtract(p[a]!, p[b]!)), distance(rest[a]!, rest[b]!) / 2);
      q[a] = add(centre, half), q[b] = subtract(centre, half);
    };
    const span = (points: Point[], from: [number, number], to: [number, number]) =>
      subtract(middle(points, ...to), middle(points, ...from));
    const hips = middle(p, 23, 24);
    const along = (from: [number, number], to: [number, number]) =>
      scaled(unit(span(p, from, to)), norm(span(rest, from, to)));
    const chest = add(hips, along([23, 24], [11, 12])), ears = add(chest, along([11, 12], [7, 8]));
    pair(23, 24, hips), pair(11, 12, chest);
    for (const [a, b] of [[11, 13], [13, 15], [12, 14], [14, 16], [23, 25], [25, 27], [24, 26], [26, 28]] as const)
      bone(a, b);
    for (const [a, ends] of [[15, [17, 19, 21]], [16, [18, 20, 22]], [27, [29, 31]], [28, [30, 32]]] as const)
      for (const b of ends) bone(a, b);
    const size = distance(rest[7]!, rest[8]!) / Math.max(distance(p[7]!, p[8]!), 1e-3);
    for (let i = 0; i <= 10; ++i) q[i] = add(ears, scaled(subtract(p[i]!, middle(p, 7, 8)), size));
    for (const [wrist, first] of [[15, BODY], [16, BODY + HAND]] as const) {
      const own = distance(rest[wrist]!, rest[wrist + 4]!), theirs = distance(p[first]!, p[first + 5]!);
      for (let i = first; i < first + HAND; ++i)
        q[i] = add(q[wrist]!, scaled(subtract(p[i]!, p[first]!), own / Math.max(theirs, 1e-3)));
    }
    return q;
  }
}

/** Landmarks as 75 points and their visibility, 0 where not seen; null without the trunk. */
export function read(given: Landmarks): { p: Point[]; visibility: number[]; hands: boolean } | null {
  const flat = typeof given[0] === "number", count = flat ? given.length / 3 : given.length;
  if (![BODY, ALL, 105].includes(count)) throw new Error(`gsgan: 33 or 75 landmarks, not ${count}`);
  const p: Point[] = [], visibility: number[] = [];
  for (let i = 0; i < ALL; ++i) {
    let point: Point = [NaN, NaN, NaN], seen = 1;
    if (i < count && flat) {
      point = [0, 1, 2].map((k) => (given as ArrayLike<number>)[3 * i + k]!) as Point;
    } else if (i < count) {
      const one = (given as ArrayLike<any>)[i];
      point = "x" in one ? [one.x, one.y, one.z] : [one[0], one[1], one[2]];
      seen = one.visibility ?? 1;
    }
    p.push(point);
    visibility.push(point.every(Number.isFinite) && seen > 0 ? Math.min(seen, 1) : 0);
  }
  if (TRUNK.some((i) => visibility[i] === 0)) return null;
  return { p, visibility, hands: count > BODY };
}

/** MediaPipe's world landmarks (hips at the origin, y down, z away) in standard axes (Z up, facing -Y). */
export function fromMediaPipe(landmarks: ArrayLike<{ x: number; y: number; z: number; visibility?: number }>) {
  return Array.from(landmarks, ({ x, y, z, visibility }) => ({ x, y: z, z: -y, visibility: visibility ?? 1 }));
}

// -- drags: gsgan.view.drag

interface Handle { chain: number[]; turned: number[]; moved: number[] }
const range = (first: number, count: number) => Array.from({ length: count }, (_, i) => first + i);
export const HANDLES: Record<string, Handle> = {};
for (const [side, shoulder, hip, hand] of [["left", 11, 23, BODY], ["right", 12, 24, BODY + HAND]] as const) {
  const [elbow, wrist, knee, ankle] = [shoulder + 2, shoulder + 4, hip + 2, hip + 4];
  const palm = [wrist + 2, wrist + 4, wrist + 6, ...range(hand, HAND)], foot = [ankle + 2, ankle + 4];
  HANDLES[`${side} wrist`] = { chain: [shoulder, elbow, wrist], turned: palm, moved: [] };
  HANDLES[`${side} elbow`] = { chain: [shoulder, elbow], turned: [], moved: [wrist, ...palm] };
  HANDLES[`${side} ankle`] = { chain: [hip, knee, ankle], turned: foot, moved: [] };
  HANDLES[`${side} knee`] = { chain: [hip, knee], turned: [], moved: [ankle, ...foot] };
}
export const NAMES = [...Object.keys(HANDLES), "head", "body"];
const ROUNDS = 20, BEND = 0.01;

/** Where a handle is. */
export function position(p: Point[], name: string): Point {
  if (name === "body") return middle(p, 23, 24);
  return name === "head" ? p[0]! : p[HANDLES[name]!.chain.at(-1)!]!;
}

/** The pose with a handle at `target`, or as near as the bones reach. */
export function dragged(p: Point[], name: string, target: Point): Point[] {
  const q = p.map((x) => [...x] as Point);
  if (name === "body") {
    const by = subtract(target, middle(p, 23, 24));
    return q.map((x) => add(x, by));
  }
  if (name === "head") {
    const neck = middle(p, 11, 12), turn = between(subtract(p[0]!, neck), subtract(target, neck));
    for (let i = 0; i <= 10; ++i) q[i] = add(neck, turn(subtract(p[i]!, neck)));
    return q;
  }
  const { chain, turned, moved } = HANDLES[name]!, [before, end] = chain.slice(-2) as [number, number];
  fabrik(chain.map((i) => p[i]!), target).forEach((x, i) => (q[chain[i]!] = x));
  const turn = between(subtract(p[end]!, p[before]!), subtract(q[end]!, q[before]!));
  for (const i of turned) q[i] = add(q[end]!, turn(subtract(p[i]!, p[end]!)));
  for (const i of moved) q[i] = add(p[i]!, subtract(q[end]!, p[end]!));
  return q;
}

function fabrik(chain: Point[], target: Point): Point[] {
  const lengths = chain.slice(1).map((x, i) => distance(x, chain[i]!)), q = chain.map((x) => [...x] as Point);
  const root = chain[0]!, along = subtract(target, root), reach = lengths.reduce((a, b) => a + b, 0);
  if (norm(along) >= reach) {
    const direction = unit(along);
    let far = 0;
    return [root, ...lengths.map((length) => add(root, scaled(direction, (far += length))))];
  }
  if (q.length > 2 && norm(cross(unit(subtract(q[1]!, root)), unit(along))) < BEND)
    for (let i = 1; i < q.length - 1; ++i)
      q[i] = add(q[i]!, scaled(unit(cross(along, [1, 2, 3])), BEND * reach));
  for (let round = 0; round < ROUNDS; ++round) {
    q[q.length - 1] = target;
    for (let i = q.length - 2; i >= 0; --i)
      q[i] = add(q[i + 1]!, scaled(unit(subtract(q[i]!, q[i + 1]!)), lengths[i]!));
    q[0] = root;
    for (let i = 0; i < lengths.length; ++i)
      q[i + 1] = add(q[i]!, scaled(unit(subtract(q[i + 1]!, q[i]!)), lengths[i]!));
  }
  return q;
}

/** The shortest rotation of one direction to another. */
function between(from: Point, to: Point): (x: Point) => Point {
  const a = unit(from), b = unit(to), axis = cross(a, b), cosine = dot(a, b);
  const pole = cross(a, Math.abs(a[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]);
  if (cosine < -1 + 1e-9) return (x) => subtract(scaled(unit(pole), 2 * dot(unit(pole), x)), x);
  return (x) => add(add(scaled(x, cosine), cross(axis, x)), scaled(axis, dot(axis, x) / (1 + cosine)));
}

export function add(a: Point, b: Point): Point { return [a[0] + b[0], a[1] + b[1], a[2] + b[2]]; }
export function subtract(a: Point, b: Point): Point { return [a[0] - b[0], a[1] - b[1], a[2] - b[2]]; }
export function scaled(a: Point, by: number): Point { return [a[0] * by, a[1] * by, a[2] * by]; }
export function dot(a: Point, b: Point): number { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
export function norm(a: Point): number { return Math.sqrt(dot(a, a)); }
export function unit(a: Point): Point { return scaled(a, 1 / Math.max(norm(a), 1e-12)); }
export function cross(a: Point, b: Point): Point {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}
function distance(a: Point, b: Point): number { return norm(subtract(a, b)); }
