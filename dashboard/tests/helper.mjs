// A mock or a real server, a browser, and what the tests ask of a page.
import { spawn } from 'node:child_process';
import { mkdirSync, readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { join } from 'node:path';
import { chromium } from 'playwright-core';

const FLAGS = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--disable-dev-shm-usage'];
const root = join(import.meta.dirname, '..');
export const OUT = process.env.PLAT_SHOTS ?? join(root, 'out');
mkdirSync(OUT, { recursive: true });
const axe = readFileSync(createRequire(import.meta.url).resolve('axe-core/axe.min.js'), 'utf8');

/** With PLAT_URL the pages of a real server are tested; what needs a particular scenario is then left out. */
export const REAL = process.env.PLAT_URL?.replace(/\/$/, '') ?? null;

export function browser() {
  return chromium.launch({ executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium', args: FLAGS });
}

export async function mock(scenario, port = 0) {
  const child = spawn(process.execPath, [join(root, 'mock', 'server.mjs'), '--scenario', scenario, '--port', String(port)], { stdio: ['ignore', 'pipe', 'inherit'] });
  const url = await new Promise((resolve, reject) => {
    child.stdout.on('data', (text) => { const m = /(http:\S+)\//.exec(String(text)); if (m) resolve(m[1]); });
    child.on('exit', (code) => reject(new Error(`the mock ended with ${code}`)));
  });
  // A test that fails must not leave a server that keeps the run alive.
  child.unref();
  child.stdout.unref();
  process.on('exit', () => child.kill('SIGKILL'));
  return {
    url,
    port: Number(new URL(url).port),
    post: (path) => fetch(url + path, { method: 'POST' }).then((r) => r.json()),
    get: (path) => fetch(url + path).then((r) => r.json()),
    stop: () => new Promise((done) => { child.ref(); child.on('exit', done); child.kill('SIGKILL'); }),
  };
}

/** A page that fails the test if a script of it throws or writes an error that is not the network's. */
export async function open(b, url, options = {}) {
  const context = await b.newContext({ viewport: { width: 1440, height: 900 }, ...options });
  const page = await context.newPage();
  page.setDefaultTimeout(10000);
  page.problems = [];
  page.on('pageerror', (e) => page.problems.push(e.message));
  page.on('console', (m) => { if (m.type() === 'error' && !/Failed to load resource|net::ERR/.test(m.text())) page.problems.push(m.text()); });
  page.on('request', (r) => { if (!r.url().startsWith(url.split('/#')[0]) && !/^(data|blob):/.test(r.url())) page.problems.push(`asked another host: ${r.url()}`); });
  await page.goto(url);
  return page;
}

/** Serious and critical violations, one line each. */
export async function violations(page) {
  await page.evaluate(axe);
  const result = await page.evaluate(() => axe.run(document, { resultTypes: ['violations'], runOnly: ['wcag2a', 'wcag2aa', 'wcag21aa', 'best-practice'] }));
  return result.violations.filter((v) => v.impact === 'serious' || v.impact === 'critical').map((v) => `${v.impact} ${v.id}: ${v.nodes.slice(0, 3).map((n) => n.html.slice(0, 160)).join(' | ')}`);
}

export const shot = (page, name) => page.screenshot({ path: join(OUT, `${name}.png`), timeout: 60000 });

/** What `check` finds, asked again until it finds something. */
export async function until(what, check, seconds = 60) {
  for (const end = Date.now() + 1000 * seconds; Date.now() < end;) {
    const found = await check();
    if (found) return found;
    await new Promise((done) => setTimeout(done, 150));
  }
  throw new Error(`not within ${seconds} s: ${what}`);
}
