/*! gsgan, Apache-2.0. Its WebAssembly holds parts of wasi-libc and musl (MIT, musl: Copyright 2005-2020 Rich Felker,
 * et al.) and of LLVM's libc++ (Apache-2.0 with LLVM exceptions); docs/web.md. */
// What the page runs, and what other programs import.
import { ELEMENT } from "./content";
import { start } from "./page";

export { Avatar, load, projected, stepped, type Orbit } from "./avatar";
export { fromMediaPipe, NAMES, position, type Landmarks, type Point } from "./body";
export type { Camera } from "./gaussians";

const element = document.getElementById(ELEMENT);
if (element) void start(element.textContent!);
