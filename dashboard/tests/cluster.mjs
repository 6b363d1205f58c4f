// plat's own programs for tests: a coordinator with its dashboard, workers, jobs; and the folder `dist` in front of a server.
import { spawn } from 'node:child_process';
import { existsSync, openSync, readFileSync } from 'node:fs';
import http from 'node:http';
import { createServer } from 'node:net';
import { extname, join, resolve } from 'node:path';

const PLAT = process.env.PLAT ?? 'plat';

export class Cluster {
  running = new Map();

  /** `folder` takes the store and the programs' logs. */
  constructor(folder) {
    this.folder = folder;
    // A test that fails must leave nothing behind.
    process.on('exit', () => { for (const child of this.running.values()) child.kill('SIGKILL'); });
  }

  start(name, ...args) {
    const log = openSync(join(this.folder, `${name}.log`), 'a');
    const child = spawn(PLAT, args.map(String), { stdio: ['ignore', log, log] });
    this.running.set(name, child);
    child.on('exit', () => { if (this.running.get(name) === child) this.running.delete(name); });
    return child;
  }

  async end(name, signal = 'SIGKILL') {
    const child = this.running.get(name);
    if (!child) return;
    const gone = new Promise((done) => child.on('exit', done));
    child.kill(signal);
    await gone;
  }

  async coordinator() {
    this.ports ??= await freePorts(3);
    const [api, pages] = this.ports;
    this.url = `http://127.0.0.1:${api}`;
    this.pages = `http://127.0.0.1:${pages}`;
    this.start('coordinator', 'coordinator', '--store', join(this.folder, 'store'), '--listen', `127.0.0.1:${api}`, '--dashboard', pages, '--lease-seconds', 3);
    await answers(this.pages);
  }

  /** The same jobs, shown by a process that outlives the coordinator. */
  async observer() {
    this.observed = `http://127.0.0.1:${this.ports[2]}`;
    this.start('observer', 'serve', '--coordinator', this.url, '--listen', this.ports[2]);
    await answers(this.observed);
  }

  worker(name) {
    this.start(name, 'worker', '--coordinator', this.url, '--threads', 1, '--name', name, '--checkpoint-every', 5);
  }

  async submit(capture, ...args) {
    const child = this.start('submit', 'submit', capture, '--coordinator', this.url, ...args);
    const code = await new Promise((done) => child.on('exit', done));
    if (code !== 0) throw new Error(`plat submit ended with ${code}: ${this.log('submit')}`);
  }

  log(name) {
    try { return readFileSync(join(this.folder, `${name}.log`), 'utf8').trim().split('\n').slice(-15).join('\n'); } catch { return ''; }
  }

  async stop() {
    for (const name of [...this.running.keys()]) await this.end(name, name === 'coordinator' ? 'SIGKILL' : 'SIGTERM');
  }
}

export async function answers(url) {
  for (let i = 0; i < 150; i += 1) {
    if (await fetch(`${url}/healthz`).then((r) => r.ok, () => false)) return;
    await new Promise((done) => setTimeout(done, 200));
  }
  throw new Error(`${url} does not answer`);
}

const TYPES = { '.html': 'text/html', '.js': 'text/javascript', '.css': 'text/css', '.wasm': 'application/wasm' };

/** PAGES=dist: the pages of this folder, compressed and with the program's own headers, instead of those in the program; everything else from the program. */
export async function front(url, pages = process.env.PAGES) {
  if (!pages) return url;
  const folder = resolve(import.meta.dirname, '..', pages);
  const policy = (await fetch(url)).headers.get('content-security-policy');
  const agent = new http.Agent({ keepAlive: true });
  const server = http.createServer((ask, reply) => {
    const path = ask.url === '/' ? '/index.html' : ask.url;
    if (path === '/index.html' || path.startsWith('/assets/')) {
      const file = join(folder, path);
      const packed = existsSync(`${file}.br`) && /\bbr\b/.test(ask.headers['accept-encoding'] ?? '');
      if (!existsSync(file)) { reply.writeHead(404).end(); return; }
      const kept = path.startsWith('/assets/') ? 'public, max-age=31536000, immutable' : 'no-cache';
      reply.writeHead(200, { 'content-type': TYPES[extname(file)] ?? 'application/octet-stream', 'cache-control': kept, ...(policy && { 'content-security-policy': policy }), ...(packed && { 'content-encoding': 'br' }) });
      reply.end(readFileSync(packed ? `${file}.br` : file));
      return;
    }
    const on = http.request(url + ask.url, { method: ask.method, headers: ask.headers, agent }, (r) => { reply.writeHead(r.statusCode, r.headers); r.pipe(reply); });
    on.on('error', () => reply.destroy());
    reply.on('close', () => on.destroy());
    ask.pipe(on);
  });
  const port = await new Promise((done) => { server.listen(0, '127.0.0.1', () => done(server.address().port)); });
  server.unref();
  return `http://127.0.0.1:${port}`;
}

async function freePorts(n) {
  const servers = await Promise.all(Array.from({ length: n }, () => new Promise((done) => { const s = createServer().listen(0, '127.0.0.1', () => done(s)); })));
  const ports = servers.map((s) => s.address().port);
  await Promise.all(servers.map((s) => new Promise((done) => s.close(done))));
  return ports;
}
