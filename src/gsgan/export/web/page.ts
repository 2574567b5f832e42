// The page: orbit, zoom, play, drag; by mouse, touch and keyboard.
import { Avatar, projected, stepped, type Orbit } from "./avatar";
import { add, NAMES, position, type Point } from "./body";
import type { Colour } from "./canvas";
import type { Camera } from "./gaussians";

const LARGEST = 1024; // pixels of the image's longer side
const TURN = 0.008, STEP = 0.12; // radians a pixel and a key
const SMOOTH = 0.9; // of the frame time that is shown
const SLOW = 1 / 24; // seconds a frame, above which a moving image is drawn smaller
const MOVE = 0.02; // metres that a key moves a handle

const element = <T extends HTMLElement>(id: string) => document.getElementById(id) as T;

export async function start(data: string): Promise<void> {
  const status = element("status");
  try {
    const page = new Page(await Avatar.of(data, element<HTMLCanvasElement>("image")));
    Object.assign(window, { gsgan: page }); // for the console and tests
    status.textContent = "";
  } catch (error) {
    status.textContent = error instanceof Error ? error.message : String(error);
  }
}

class Page {
  readonly orbit: Orbit;
  camera: Camera;
  motion = 0;
  frame = 0;
  playing = false;
  rate = 0; // frames per second
  private background: Colour = [1, 1, 1, 1];
  private readonly canvas = element<HTMLCanvasElement>("image");
  private readonly motions = element<HTMLSelectElement>("motion");
  private readonly scrub = element<HTMLInputElement>("frame");
  private readonly button = element<HTMLButtonElement>("play");
  private readonly handles = new Map<string, HTMLButtonElement>();
  private readonly fingers = new Map<number, [number, number]>();
  private offset: Point = [0, 0, 0]; // of the camera's target from the person
  private height = 0; // of that target
  private dragged = false; // the pose is not the motion's
  private moving = 0; // time of the last change
  private drawn = 0;
  private seconds = 0; // of a frame, smoothed
  private quality = 1;
  private still = false; // the image is drawn as trained
  private due = false;

  constructor(readonly avatar: Avatar) {
    const target = position(avatar.landmarks, "body");
    this.orbit = { azimuth: 0.35, elevation: 0.1, distance: this.far(), target };
    this.camera = avatar.camera(this.orbit, 1, 1);
    avatar.header.motions.forEach(({ name }, i) => this.motions.add(new Option(name, String(i))));
    this.motions.onchange = () => this.choose(Number(this.motions.value));
    this.scrub.oninput = () => this.show(Number(this.scrub.value));
    this.button.onclick = () => this.run(!this.playing);
    element("reset").onclick = () => this.show(this.frame);
    element("save").onclick = () => void this.save();
    const colour = element<HTMLInputElement>("background");
    colour.oninput = () => {
      const [r, g, b] = [1, 3, 5].map((i) => parseInt(colour.value.slice(i, i + 2), 16) / 255);
      this.background = [r!, g!, b!, 1];
      this.changed();
    };
    element<HTMLInputElement>("drag").onchange = () => this.place();
    for (const name of NAMES) this.handles.set(name, this.handle(name));
    this.canvas.onpointerdown = (event) => this.touch(event);
    this.canvas.onpointermove = (event) => this.slide(event);
    this.canvas.onpointerup = this.canvas.onpointercancel = (event) => void this.fingers.delete(event.pointerId);
    this.canvas.oncontextmenu = (event) => event.preventDefault();
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(0.001 * event.deltaY));
    }, { passive: false });
    this.canvas.onkeydown = (event) => this.key(event);
    new ResizeObserver(() => this.changed()).observe(this.canvas);
    this.choose(Math.min(1, avatar.header.motions.length - 1));
    this.run(avatar.header.motions[this.motion]!.frames > 1 && !matchMedia("(prefers-reduced-motion)").matches);
  }

  /** A distance from which the standing person fills the image. */
  private far(): number {
    const heights = this.avatar.header.rest.map((x) => x[2]!);
    return 1.9 * (Math.max(...heights) - Math.min(...heights));
  }

  // -- motion

  choose(motion: number): void {
    const { frames } = this.avatar.header.motions[motion]!;
    this.motion = motion;
    this.motions.value = String(motion);
    this.scrub.max = String(frames - 1);
    this.scrub.disabled = this.button.disabled = frames < 2;
    this.show(0);
    this.offset = [0, 0, 0];
    this.height = this.avatar.toStandard(position(this.avatar.landmarks, "body"))[2];
    this.follow();
  }

  /** The camera goes along with the person, not up and down. */
  private follow(): void {
    const [x, y] = this.avatar.toStandard(position(this.avatar.landmarks, "body"));
    this.orbit.target = add(this.avatar.toWorld([x, y, this.height]), this.offset);
  }

  show(frame: number): void {
    this.frame = frame;
    this.dragged = false;
    this.avatar.play(this.motion, frame);
    this.follow();
    this.scrub.value = String(Math.floor(frame));
    this.scrub.ariaValueText = `frame ${Math.floor(frame) + 1} of ${this.avatar.header.motions[this.motion]!.frames}`;
    this.changed();
  }

  run(playing: boolean): void {
    this.playing = playing && this.avatar.header.motions[this.motion]!.frames > 1;
    this.button.textContent = this.playing ? "pause" : "play";
    this.changed();
  }

  // -- the image

  changed(): void {
    this.moving = performance.now();
    this.still = false;
    this.request();
  }

  private request(): void {
    if (!this.due) requestAnimationFrame((now) => this.tick(now));
    this.due = true;
  }

  private tick(now: number): void {
    this.due = false;
    const passed = (now - this.drawn) / 1000, { frames, fps } = this.avatar.header.motions[this.motion]!;
    this.drawn = now;
    if (passed < 0.5) {
      this.seconds = this.seconds ? SMOOTH * this.seconds + (1 - SMOOTH) * passed : passed;
      this.rate = 1 / this.seconds;
      if (this.playing) this.quality = Math.max(0.35, Math.min(1, this.quality * (this.seconds > SLOW ? 0.98 : 1.01)));
    }
    if (this.playing && !this.dragged) {
      const frame = (this.frame + Math.min(passed, 0.2) * fps) % frames;
      this.show(frame);
    }
    const rest = !this.playing && now - this.moving > 150;
    if (!rest || !this.still) this.draw(rest);
    this.still = rest;
    element("rate").textContent = this.playing ? `${this.rate.toFixed(0)} frames/s` : "";
    if (!this.still) this.request();
  }

  /** Draws the image, at rest with as many samples as in training. */
  draw(rest: boolean): void {
    const box = this.canvas.getBoundingClientRect(), longer = Math.max(box.width, box.height, 1);
    const scale = Math.min(devicePixelRatio, LARGEST / longer) * (rest ? 1 : this.quality);
    const [width, height] = [box.width, box.height].map((x) => Math.max(1, Math.round(x * scale)));
    this.camera = this.avatar.camera(this.orbit, width!, height!);
    const times = rest ? this.avatar.header.supersample : 1;
    this.avatar.draw(this.camera, { background: this.background, times });
    this.place();
  }

  private async save(): Promise<void> {
    this.draw(true);
    const link = document.createElement("a");
    link.href = URL.createObjectURL(await this.avatar.image());
    link.download = `${this.avatar.header.name}.png`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  }

  // -- the camera

  private turn(dx: number, dy: number): void {
    this.orbit.azimuth -= dx;
    this.orbit.elevation = Math.max(-1.5, Math.min(1.5, this.orbit.elevation + dy));
    this.changed();
  }

  private zoom(by: number): void {
    this.orbit.distance = Math.max(0.3, Math.min(20, this.orbit.distance * by));
    this.changed();
  }

  private pan(dx: number, dy: number): void {
    const step = stepped(this.camera, this.orbit.distance, [-dx * this.pixels(), -dy * this.pixels()]);
    this.offset = add(this.offset, step);
    this.orbit.target = add(this.orbit.target, step);
    this.changed();
  }

  /** Pixels of the drawn image per pixel of the page. */
  private pixels(): number {
    return this.camera.height / Math.max(this.canvas.getBoundingClientRect().height, 1);
  }

  private touch(event: PointerEvent): void {
    this.canvas.focus();
    this.canvas.setPointerCapture(event.pointerId);
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  private slide(event: PointerEvent): void {
    const before = this.fingers.get(event.pointerId);
    if (!before) return;
    const now: [number, number] = [event.clientX, event.clientY], other = this.other(event.pointerId);
    const dx = now[0] - before[0], dy = now[1] - before[1];
    this.fingers.set(event.pointerId, now);
    if (other) {
      const length = (a: [number, number]) => Math.hypot(a[0] - other[0], a[1] - other[1]);
      this.zoom(length(before) / Math.max(length(now), 1));
      this.pan(dx / 2, dy / 2);
    } else if (event.buttons & 2 || event.shiftKey) {
      this.pan(dx, dy);
    } else {
      this.turn(TURN * dx, TURN * dy);
    }
  }

  private other(id: number): [number, number] | undefined {
    return [...this.fingers].find(([finger]) => finger !== id)?.[1];
  }

  private key(event: KeyboardEvent): void {
    const turns: Record<string, [number, number]> = {
      ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, -STEP], ArrowDown: [0, STEP],
    };
    if (event.key in turns) this.turn(...turns[event.key]!);
    else if (event.key === "+" || event.key === "=") this.zoom(0.9);
    else if (event.key === "-") this.zoom(1 / 0.9);
    else if (event.key === " ") this.run(!this.playing);
    else return;
    event.preventDefault();
  }

  // -- handles

  private handle(name: string): HTMLButtonElement {
    const made = document.createElement("button");
    made.className = "handle";
    made.ariaLabel = `move the ${name}: drag, or arrow keys, page up and page down`;
    made.title = name;
    let from: [number, number] | null = null;
    made.onpointerdown = (event) => {
      from = [event.clientX, event.clientY];
      made.setPointerCapture(event.pointerId);
      event.preventDefault();
      made.focus();
    };
    made.onpointermove = (event) => {
      if (!from) return;
      this.pull(name, [event.clientX - from[0], event.clientY - from[1]], 0);
      from = [event.clientX, event.clientY];
    };
    made.onpointerup = made.onpointercancel = () => (from = null);
    made.onkeydown = (event) => {
      const way: Record<string, Point> = {
        ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0], ArrowUp: [0, -1, 0], ArrowDown: [0, 1, 0],
        PageUp: [0, 0, -1], PageDown: [0, 0, 1],
      };
      const step = way[event.key];
      if (!step) return;
      event.preventDefault();
      const metres = this.camera.K[0]! / this.pixels() / projected(this.camera, position(this.avatar.landmarks, name))[2];
      this.pull(name, [step[0] * MOVE * metres, step[1] * MOVE * metres], step[2] * MOVE);
    };
    element("handles").append(made);
    return made;
  }

  /** Moves a handle by pixels of the page and metres away from the camera. */
  private pull(name: string, [dx, dy]: [number, number], away: number): void {
    this.run(false);
    const at = position(this.avatar.landmarks, name), depth = projected(this.camera, at)[2];
    this.avatar.drag(name, add(at, stepped(this.camera, depth, [dx * this.pixels(), dy * this.pixels()], away)));
    this.dragged = true;
    this.changed();
  }

  /** Puts the handles where their joints are. */
  private place(): void {
    const shown = element<HTMLInputElement>("drag").checked, scale = 1 / this.pixels();
    element("handles").hidden = !shown;
    if (!shown) return;
    for (const [name, button] of this.handles) {
      const [x, y, z] = projected(this.camera, position(this.avatar.landmarks, name));
      button.hidden = z <= 0;
      button.style.transform = `translate(${x * scale}px, ${y * scale}px)`;
    }
  }
}
