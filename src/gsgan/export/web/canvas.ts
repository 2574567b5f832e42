// Draws ellipses into a WebGL2 canvas: blended back to front in half floats, averaged, put over a background.
import { FLOATS, ROW } from "./gaussians";

const ELLIPSE = `#version 300 es
uniform highp sampler2D ellipses; // three texels each: centre, opacity, factor, colour
uniform vec2 size;
uniform float alphaMin;
out highp vec2 at;
flat out highp vec4 paint;
const vec2 CORNERS[6] = vec2[](vec2(-1, -1), vec2(1, -1), vec2(-1, 1), vec2(-1, 1), vec2(1, -1), vec2(1, 1));
void main() {
  int i = gl_VertexID / 6;
  ivec2 first = ivec2(3 * (i % ${ROW}), i / ${ROW});
  vec4 place = texelFetch(ellipses, first, 0), more = texelFetch(ellipses, first + ivec2(1, 0), 0);
  vec4 last = texelFetch(ellipses, first + ivec2(2, 0), 0);
  at = sqrt(2.0 * log(place.z / alphaMin)) * CORNERS[gl_VertexID % 6];
  vec2 pixel = place.xy + vec2(place.w * at.x, more.x * at.x + more.y * at.y);
  gl_Position = vec4(2.0 * pixel / size - 1.0, 0.0, 1.0);
  paint = vec4(more.zw, last.x, place.z);
}`;
const BLEND = `#version 300 es
precision highp float;
in vec2 at;
flat in vec4 paint;
uniform float alphaMin, alphaMax;
out vec4 value;
void main() {
  float alpha = min(paint.a * exp(-0.5 * dot(at, at)), alphaMax);
  if (alpha < alphaMin) discard;
  value = vec4(paint.rgb * alpha, alpha);
}`;
const WHOLE = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;
const AVERAGE = `#version 300 es
precision highp float;
uniform highp sampler2D drawn;
uniform int times, height;
uniform vec4 background;
out vec4 value;
void main() {
  ivec2 first = times * ivec2(int(gl_FragCoord.x), height - 1 - int(gl_FragCoord.y));
  vec4 sum = vec4(0.0);
  for (int y = 0; y < times; ++y)
    for (int x = 0; x < times; ++x) sum += texelFetch(drawn, first + ivec2(x, y), 0);
  value = sum / float(times * times);
  value += (1.0 - value.a) * vec4(background.rgb * background.a, background.a);
}`;

export type Colour = readonly [red: number, green: number, blue: number, alpha: number];

export class Drawing {
  private readonly gl: WebGL2RenderingContext;
  private ellipse!: WebGLProgram;
  private average!: WebGLProgram;
  private ellipses!: WebGLTexture;
  private target!: WebGLFramebuffer;
  private texture!: WebGLTexture;
  private drawn = [0, 0];
  private rows = 0; // of the ellipses' texture

  /** `restored` is called when a lost context is back and the image has to be drawn again. */
  constructor(readonly canvas: HTMLCanvasElement, restored: () => void) {
    const gl = canvas.getContext("webgl2", { alpha: true, antialias: false, depth: false });
    if (!gl) throw new Error("gsgan: this browser has no WebGL 2");
    this.gl = gl;
    this.start();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this.start();
      restored();
    });
  }

  private start(): void {
    const { gl } = this;
    this.drawn = [0, 0];
    this.ellipse = this.program(ELLIPSE, BLEND);
    this.average = this.program(WHOLE, AVERAGE);
    this.target = gl.createFramebuffer();
    this.texture = this.plain();
    this.ellipses = this.plain();
    this.rows = 0;
  }

  private plain(): WebGLTexture {
    const { gl } = this, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return texture;
  }

  private program(vertex: string, fragment: string): WebGLProgram {
    const { gl } = this, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]] as const) {
      const shader = gl.createShader(kind)!;
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
      throw new Error(`gsgan: ${gl.getProgramInfoLog(program)}`);
    return program;
  }

  /** Draws `count` ellipses into an image of width x height pixels, `times` pixels for each of them. */
  draw(
    ellipses: Float32Array, count: number, [width, height]: [number, number], times: number,
    [alphaMin, alphaMax]: [number, number], background: Colour,
  ): void {
    const { gl, canvas, ellipse, average } = this;
    if (gl.isContextLost()) return;
    if (canvas.width !== width || canvas.height !== height) canvas.width = width, canvas.height = height;
    const size = [width * times, height * times] as [number, number];
    this.resize(size);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.viewport(0, 0, ...size);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(ellipse);
    gl.uniform2f(gl.getUniformLocation(ellipse, "size"), ...size);
    gl.uniform1f(gl.getUniformLocation(ellipse, "alphaMin"), alphaMin);
    gl.uniform1f(gl.getUniformLocation(ellipse, "alphaMax"), alphaMax);
    this.upload(ellipses, count);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.TRIANGLES, 0, 6 * count); // instances of four vertices are slow in software
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.useProgram(average);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.uniform1i(gl.getUniformLocation(average, "times"), times);
    gl.uniform1i(gl.getUniformLocation(average, "height"), height);
    gl.uniform4f(gl.getUniformLocation(average, "background"), ...background);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  private upload(ellipses: Float32Array, count: number): void {
    const { gl } = this, width = (ROW * FLOATS) / 4, rows = Math.ceil(count / ROW);
    gl.bindTexture(gl.TEXTURE_2D, this.ellipses);
    if (rows > this.rows) {
      this.rows = rows;
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, width, rows, 0, gl.RGBA, gl.FLOAT, null);
    }
    if (rows > 0) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, rows, gl.RGBA, gl.FLOAT, ellipses);
  }

  private resize(size: [number, number]): void {
    const { gl } = this;
    if (this.drawn[0] === size[0] && this.drawn[1] === size[1]) return;
    this.drawn = size;
    // without the extension eight bits: every blend is rounded
    const half = gl.getExtension("EXT_color_buffer_float") ?? gl.getExtension("EXT_color_buffer_half_float");
    const kind = half ? gl.HALF_FLOAT : gl.UNSIGNED_BYTE;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, half ? gl.RGBA16F : gl.RGBA8, ...size, 0, gl.RGBA, kind, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.texture, 0);
  }
}
