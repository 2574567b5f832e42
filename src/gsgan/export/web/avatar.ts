// The door for other programs: const avatar = await load("avatar.html", canvas); pose; draw.
import { Body, dragged, position, read, add, scaled, subtract, type Landmarks, type Point } from "./body";
import { Drawing, type Colour } from "./canvas";
import { unpacked, type Content, type Header } from "./content";
import { Gaussians, type Camera } from "./gaussians";

/** Where an orbiting camera stands. */
export interface Orbit {
  azimuth: number; // radians about the up axis, 0 in front of the person
  elevation: number; // radians
  distance: number; // metres
  target: Point; // of the world
}

export class Avatar {
  readonly header: Header;
  /** The body's own 75 landmarks in the current pose, metres in the world. */
  landmarks: Point[] = [];
  private readonly gaussians: Gaussians;
  private readonly drawing: Drawing;
  private last: (() => void) | null = null;
  private bones = new Float32Array();

  private constructor(private readonly content: Content, private readonly body: Body, canvas: HTMLCanvasElement) {
    this.header = content.header;
    this.gaussians = new Gaussians(content);
    this.drawing = new Drawing(canvas, () => this.last?.());
    this.play(0, 0);
  }

  static async of(data: string | ArrayBuffer, canvas: HTMLCanvasElement): Promise<Avatar> {
    const content = await unpacked(data);
    return new Avatar(content, await Body.of(content), canvas);
  }

  /** Takes the pose of a motion's frame; the rest pose is motion 0. */
  play(motion: number, frame: number): void {
    const { step, frames } = this.header.motions[motion]!, size = 3 * this.header.bones;
    const i = Math.max(0, Math.min(Math.floor(frame), frames - 1));
    const theta = this.content.array(`theta${motion}`, "i2").subarray(i * size, (i + 1) * size);
    const transl = this.content.array(`transl${motion}`, "f4").subarray(3 * i, 3 * i + 3);
    this.take(this.body.moved(Float32Array.from(theta, (x) => step * x), transl));
  }

  /**
   * Takes the pose nearest to 33 or 75 landmarks in MediaPipe's order, metres in the world's axes.
   *
   * Landmarks that are NaN or have no visibility keep their places relative to the hips. Returns
   * false, and keeps its pose, where a shoulder or hip is not seen.
   *
   * `standard`: the axes have Z up and the person faces -Y, as `fromMediaPipe` has them; the feet are
   * put on the ground. `retarget`: another person's landmarks, whose directions the subject takes.
   */
  pose(given: Landmarks, { standard = false, retarget = false } = {}): boolean {
    const found = read(given);
    if (!found) return false;
    let { p, visibility, hands } = found;
    const now = standard ? this.landmarks.map((x) => this.toStandard(x)) : this.landmarks;
    const by = subtract(position(p, "body"), position(now, "body"));
    p = p.map((x, i) => (visibility[i]! > 0 ? x : add(now[i]!, by)));
    if (retarget) p = this.body.retargeted(p);
    if (standard) {
      const low = Math.min(...[27, 28, 29, 30, 31, 32].map((i) => p[i]![2]));
      const centre = this.toStandard(this.header.centre as Point), hips = position(p, "body");
      const shift: Point = [centre[0] - hips[0], centre[1] - hips[1], this.header.ground - low];
      p = p.map((x) => this.toWorld(add(x, shift)));
    }
    this.take(this.body.solved(p, visibility, hands));
    return true;
  }

  /** Drags a handle (`NAMES`) to a point of the world; limbs bend by FABRIK. */
  drag(name: string, target: Point): void {
    const p = dragged(this.landmarks, name, target);
    this.take(this.body.solved(p, p.map(() => 1), true));
  }

  private take(bones: Float32Array<ArrayBufferLike>): void {
    this.bones = bones as Float32Array<ArrayBuffer>;
    this.landmarks = this.body.landmarks(bones);
    this.gaussians.pose(this.bones);
  }

  /** Draws the image, `times` x `times` samples for each of its pixels: as trained unless given. */
  draw(camera: Camera, { background = [0, 0, 0, 0] as Colour, times = this.header.supersample } = {}): void {
    this.last = () => {
      const { alphaMin, alphaMax } = this.header, size = [camera.width, camera.height] as [number, number];
      const count = this.gaussians.project(camera, times);
      this.drawing.draw(this.gaussians.ellipses, count, size, times, [alphaMin, alphaMax], background);
    };
    this.last();
  }

  /** The current image as a PNG file that says it is synthetic. */
  async image(): Promise<Blob> {
    this.last?.();
    const png = await new Promise<Blob | null>((done) => this.drawing.canvas.toBlob(done, "image/png"));
    return marked(new Uint8Array(await png!.arrayBuffer()), this.header.xmp);
  }

  /** A camera that looks at a point, with 1.5 heights of the image as its focal length. */
  camera(orbit: Orbit, width: number, height: number): Camera {
    const { azimuth, elevation, distance, target } = orbit, c = Math.cos(elevation), s = Math.sin(elevation);
    const rows: Point[] = [
      [Math.cos(azimuth), Math.sin(azimuth), 0],
      [-s * Math.sin(azimuth), s * Math.cos(azimuth), -c],
      [-c * Math.sin(azimuth), c * Math.cos(azimuth), -s],
    ];
    const R = rows.map((row) => this.toWorld(row)).flat(), f = 1.5 * Math.max(height, width * 0.5);
    const t = [0, 1, 2].map((i) => -(R[3 * i]! * target[0] + R[3 * i + 1]! * target[1] + R[3 * i + 2]! * target[2]));
    t[2]! += distance;
    return { K: [f, 0, width / 2, 0, f, height / 2, 0, 0, 1], R, t, width, height };
  }

  toWorld([x, y, z]: Point): Point {
    const a = this.header.axes;
    return [0, 3, 6].map((i) => a[i]! * x + a[i + 1]! * y + a[i + 2]! * z) as Point;
  }

  toStandard([x, y, z]: Point): Point {
    const a = this.header.axes;
    return [0, 1, 2].map((i) => a[i]! * x + a[i + 3]! * y + a[i + 6]! * z) as Point;
  }
}

/** An avatar of a page or bare file (its address or content), drawn into a canvas. */
export async function load(source: string | ArrayBuffer, canvas = document.createElement("canvas")): Promise<Avatar> {
  if (typeof source !== "string") return Avatar.of(source, canvas);
  const answer = await fetch(source);
  if (!answer.ok) throw new Error(`gsgan: ${source}: ${answer.status} ${answer.statusText}`);
  return Avatar.of(await answer.arrayBuffer(), canvas);
}

/** Pixels of world points, and their depths. */
export function projected({ K, R, t }: Camera, x: Point): [number, number, number] {
  const [a, b, c] = [0, 1, 2].map((i) =>
    R[3 * i]! * x[0] + R[3 * i + 1]! * x[1] + R[3 * i + 2]! * x[2] + t[i]!) as Point;
  return [(K[0]! * a + K[1]! * b) / c + K[2]!, (K[4]! * b) / c + K[5]!, c];
}

/** How far a point of the world moves for a step on the image, pixels, at its own depth. */
export function stepped({ K, R }: Camera, depth: number, [dx, dy]: [number, number], towards = 0): Point {
  const step: Point = [(dx * depth) / K[0]!, (dy * depth) / K[4]!, towards];
  const axis = (i: number): Point => [R[3 * i]!, R[3 * i + 1]!, R[3 * i + 2]!];
  return add(add(scaled(axis(0), step[0]), scaled(axis(1), step[1])), scaled(axis(2), step[2]));
}

/** A PNG file with XMP in an iTXt chunk, after its header of 33 bytes. */
function marked(png: Uint8Array<ArrayBuffer>, xmp: string): Blob {
  const body = new TextEncoder().encode(`iTXtXML:com.adobe.xmp\0\0\0\0\0${xmp}`);
  const chunk = new DataView(new ArrayBuffer(body.length + 8));
  chunk.setUint32(0, body.length - 4);
  body.forEach((byte, i) => chunk.setUint8(4 + i, byte));
  let crc = -1;
  for (const byte of body) {
    crc ^= byte;
    for (let k = 0; k < 8; ++k) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
  }
  chunk.setInt32(4 + body.length, ~crc);
  return new Blob([png.subarray(0, 33), chunk, png.subarray(33)], { type: "image/png" });
}
