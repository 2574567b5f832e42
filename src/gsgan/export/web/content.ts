// The avatar's file: a deflated block of a JSON header and arrays, in base64 where it is in a page.

export interface Header {
  version: number;
  name: string;
  xmp: string; // says that images are synthetic, for files that are saved
  count: number; // N Gaussians
  degree: number; // of the colour's spherical harmonics
  follow: number[]; // numbers of a Gaussian that follow its normal
  bones: number; // J
  weights: number; // bones of each Gaussian
  slopes: number; // bones whose weights change along the surface
  slopeStep: number; // of their gradients, 1 / metre
  stretch: number | null; // largest norm of what they add to a frame; null: any
  range: [number, number]; // least and step of the quantised means, metres
  bound: number; // of the means' residuals, metres
  height: number; // metres: the unit of these residuals where they have no bound
  scales: [number, number]; // least and greatest, log metres
  logit: number; // greatest, of opacities
  lowPass: number; // square pixels
  alphaMin: number;
  alphaMax: number;
  fovClamp: number;
  near: number; // metres
  antialias: boolean;
  supersample: number;
  axes: number[]; // 3 x 3, from standard axes (Z up, facing -Y) to the world's
  ground: number; // metres along the standard Z
  centre: number[]; // of the scene, in the world
  rest: number[][]; // the subject's 33 landmarks in the standard pose
  motions: { name: string; fps: number; frames: number; step: number }[];
  arrays: Record<string, [kind: string, offset: number, length: number]>;
}

const KINDS = {
  i1: Int8Array, u1: Uint8Array, i2: Int16Array, u2: Uint16Array, f4: Float32Array,
} as const;
type Kinds = typeof KINDS;

export class Content {
  readonly header: Header;
  private readonly start: number;

  constructor(private readonly block: ArrayBuffer) {
    const size = new DataView(block).getUint32(0, true);
    this.start = 8 + size; // a multiple of 8
    this.header = JSON.parse(new TextDecoder().decode(new Uint8Array(block, 8, size)));
  }

  array<K extends keyof Kinds>(name: string, kind: K): InstanceType<Kinds[K]> {
    const [stored, offset, length] = this.header.arrays[name]!;
    if (stored !== kind) throw new Error(`gsgan: ${name} is ${stored}, not ${kind}`);
    return new KINDS[kind](this.block, this.start + offset, length) as InstanceType<Kinds[K]>;
  }
}

export const ELEMENT = "gsgan-avatar"; // id of the element of a page that holds the block

/** The content of a page's text or of the bare block. */
export async function unpacked(data: string | ArrayBuffer): Promise<Content> {
  let block = data;
  if (typeof block !== "string" && new Uint8Array(block)[0] === 60) // "<"
    block = new TextDecoder().decode(block);
  if (typeof block === "string") {
    const found = /id="gsgan-avatar">([^<]*)</.exec(block);
    const text = atob((found ? found[1]! : block).trim());
    block = Uint8Array.from(text, (letter) => letter.charCodeAt(0)).buffer;
  }
  const stream = new Blob([block]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Content(await new Response(stream).arrayBuffer());
}
