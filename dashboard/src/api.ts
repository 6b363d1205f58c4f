// The contract with the server: its types, and the few ways to ask it. null = not known or not measured.

export interface Server {
  version: string;
  kind: 'train' | 'coordinator' | 'folder';
  controls: boolean;
  store_url: string | null;
  coordinator: null | { url: string; reachable: boolean; silent_millis: number };
}

export interface Job {
  id: number;
  name: string;
  plan: string;
  state: 'running' | 'paused' | 'done' | 'incomplete' | 'cancelled';
  phase: 'detect' | 'train' | 'evaluate' | 'merge' | 'done';
  backend: string;
  priority: number;
  weight: number;
  blocks: number;
  evaluations: number;
  detections: number;
  objects: number;
  levels: number;
  counts: { waiting: number; ready: number; leased: number; done: number; failed: number; quarantined: number };
  started_unix_ms: number | null;
  ended_unix_ms: number | null;
  steps_done: number;
  steps_all: number;
  /** On how many photos objects were looked for, of how many; 0 of 0 if nobody looks for any. */
  photos_done: number;
  photos_all: number;
  splats: number;
  cpu_seconds: number;
  eta_seconds: null | [low: number, high: number];
  eta_note: string;
  psnr: number | null;
  ssim: number | null;
  perceptual: number | null;
  model: boolean;
}

export interface Worker {
  name: string;
  backend: string;
  state: 'busy' | 'idle' | 'lost' | 'left';
  job: number | null;
  task: number | null;
  attempt: number;
  heard_unix_ms: number;
  since_unix_ms: number;
  idle_reason: string;
  memory_bytes: number;
  done: number;
  failed: number;
  steps_per_second: number | null;
}

export interface Event {
  number: number;
  unix_ms: number;
  job: number | null;
  task: number | null;
  attempt: number;
  worker: string;
  level: 'info' | 'warn' | 'error';
  what: string;
  /** What the event does to its attempt; read from `what` where the server does not say. */
  kind?: 'began' | 'done' | 'failed' | 'lost' | 'revoked' | '';
}

export interface Snapshot {
  seq: number;
  now_unix_ms: number;
  server: Server;
  jobs: Job[];
  workers: Worker[];
  events: Event[];
}

/** One task's change: task, state letter, progress in permille, splats, loss, steps per second, worker, attempt. */
export interface TaskChange {
  t: number;
  s: Letter;
  p: number;
  n: number;
  l: number | null;
  v: number | null;
  w: string;
  a: number;
  /** PSNR of the block, once measured; absent from servers that do not say it here. */
  q?: number | null;
}

export interface Delta {
  now_unix_ms: number;
  server: Server | null;
  jobs: Job[];
  workers: Worker[];
  events: Event[];
  tasks: Record<string, TaskChange[]>;
}

export type Letter = 'w' | 'r' | 'l' | 'd' | 'f' | 'q';

export interface Square {
  x: number;
  y: number;
  edge: number;
}

export interface Plan {
  plan: string;
  name: string;
  levels: number;
  root: Square;
  north_up: boolean;
  geo: null | { latitude: number; longitude: number };
  blocks: { level: number[]; x: number[]; y: number[]; steps: number[]; budget: number[]; rho_metres: number[]; views: number[] };
  evaluations: number;
  detections: number;
  objects: number;
  cameras: { x: number[]; y: number[]; test: number[] };
  points: { x: number[]; y: number[] };
}

export interface Tasks {
  seq: number;
  state: string;
  progress: number[];
  splats: number[];
  loss: (number | null)[];
  speed: (number | null)[];
  worker: string[];
  attempt: number[];
  psnr: (number | null)[];
}

export interface Attempt {
  number: number;
  worker: string;
  began_unix_ms: number;
  ended_unix_ms: number | null;
  end: 'running' | 'done' | 'failed' | 'lost' | 'revoked';
  reason: string;
}

export type Band = [p10: number, p50: number, p90: number];

export interface Task {
  task: number;
  block: string | null;
  kind: 'train' | 'evaluate' | 'detect' | 'object';
  state: string;
  steps: number;
  budget: number;
  rho_metres: number;
  memory_bytes: number;
  parent: number | null;
  neighbours: number[];
  attempts: Attempt[];
  curve: { attempt: number[]; step: number[]; loss: (number | null)[]; splats: number[]; cpu_seconds: number[]; wall_seconds: number[] };
  fleet: { share: number[]; loss: Band[]; splats: Band[] };
  psnr: number | null;
}

export interface Camera {
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  world_from_camera: number[];
}

export interface View {
  view: number;
  name: string;
  width: number;
  height: number;
  test: boolean;
  camera: Camera;
  photo: boolean;
  psnr: number | null;
  ssim: number | null;
  perceptual: number | null;
  street: boolean | null;
  task?: number | null;
}

export interface ModelBlock {
  block: string;
  task: number;
  artefact: string | null;
  splats: number;
  rho_metres: number;
  box: number[] | null;
  backdrop: boolean;
  /** What the file's places are relative to, itself relative to the model's centre. */
  origin?: [number, number, number];
}

export interface ModelView {
  seq: number;
  root: Square;
  centre: [number, number, number];
  blocks: ModelBlock[];
  sh_degree: number;
  antialiased: boolean;
  /** Which formats of blocks there are; tried out where the server does not say. */
  formats?: ('rad' | 'spz')[];
  /** Quaternion (x, y, z, w) from the files' axes to those of the ground plane. */
  turn?: [number, number, number, number];
  /** Where two blocks of the finest model meet: how far their pictures differ there, and the error's step across, levels of 255. */
  faces?: { a: string; b: string; jump: number | null; step: number | null }[];
}

export interface Curve {
  cpu_seconds: number[];
  wall_seconds: number[];
  psnr: number[];
  splats: (number | null)[];
}

export interface Result {
  label: string;
  scene: string;
  source: string | null;
  commit: string | null;
  machine: string | null;
  backend: string | null;
  workers: number | null;
  downscale: number | null;
  steps: number | null;
  budget: number | null;
  splats: number | null;
  cpu_seconds: number | null;
  wall_seconds: number | null;
  psnr: number | null;
  ssim: number | null;
  lpips: number | null;
  perceptual: number | null;
  split: string;
  curve: { cpu_seconds: number; psnr: number; splats: number | null }[];
  own: boolean;
}

export interface Download {
  name: string;
  path: string;
  bytes: number;
  blake3: string | null;
}

export interface Control {
  what: 'pause' | 'resume' | 'cancel' | 'retry' | 'priority';
  tasks?: number[];
  priority?: number;
  weight?: number;
}

/** GET as JSON. An error carries the server's own line, which says what to do. */
export async function get<T>(path: string): Promise<T> {
  return answer<T>(await fetch(path, { headers: { accept: 'application/json' } }), path);
}

export async function control(job: number, body: Control): Promise<void> {
  const path = `/api/jobs/${job}/control`;
  await answer(await fetch(path, { method: 'POST', headers: { 'content-type': 'application/json' }, body: JSON.stringify(body) }), path);
}

async function answer<T>(reply: Response, path: string): Promise<T> {
  if (reply.ok) return (await reply.json()) as T;
  const told = await reply.json().catch(() => null) as { error?: string } | null;
  throw new Error(told?.error ?? `${path}: the server answered ${reply.status}`);
}
