// How soon the viewer shows something, over a slow line: 20 Mbit/s and 50 ms, by Chromium's own emulation.
//   URL=http://127.0.0.1:7420 node tests/first-picture.mjs [MODEL'S JOB]
//   PAGES=dist         this folder's pages instead of the program's; PAGES=/tmp/before,dist compares two, by turns
//   ROUNDS=3           loads of each, and their medians; one load at full speed comes before, so that the server has made its files
//   TIMELINE=1         every request of each load: asked, first byte, last byte, in milliseconds
// The first picture is the first frame with 10,000 splats that the GPU has finished. Says too what had come by then, and what comes afterwards.
import { front } from './cluster.mjs';
import { browser, open, shot } from './helper.mjs';

const [MBIT, LATENCY, SPLATS] = [Number(process.env.MBIT ?? 20), 50, 10000];
const ROUNDS = Number(process.env.ROUNDS ?? 1);
const server = process.env.URL ?? 'http://127.0.0.1:7288';
const b = await browser();

/** In the page: notes when a draw of so many instances was issued, and when the GPU had finished it. */
function watch(splats) {
  for (const name of ['drawElementsInstanced', 'drawArraysInstanced']) {
    const draw = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function drawn(...args) {
      draw.apply(this, args);
      if (globalThis.firstPicture || args.at(-1) < splats) return;
      globalThis.firstPicture = { splats: args.at(-1), issued: performance.now(), finished: 0 };
      const fence = this.fenceSync(this.SYNC_GPU_COMMANDS_COMPLETE, 0);
      const look = () => { if (this.clientWaitSync(fence, 0, 0) === this.TIMEOUT_EXPIRED) setTimeout(look, 5); else globalThis.firstPicture.finished = performance.now(); };
      setTimeout(look, 5);
    };
  }
}

async function measure(pages, slow) {
  const url = pages.url;
  const page = await open(b, 'about:blank', { viewport: { width: 1280, height: 800 } });
  page.problems = [];
  await page.addInitScript(watch, SPLATS);
  const cdp = await page.context().newCDPSession(page);
  await cdp.send('Network.enable');
  const requests = new Map();
  let began = 0;
  cdp.on('Network.requestWillBeSent', (e) => {
    if (!e.request.url.startsWith('http')) return;
    began ||= e.timestamp;
    requests.set(e.requestId, { path: e.request.url.slice(url.length), range: e.request.headers.range ?? e.request.headers.Range ?? '', asked: e.timestamp, pieces: [] });
  });
  cdp.on('Network.responseReceived', (e) => { const r = requests.get(e.requestId); if (r) r.head = e.timestamp; });
  cdp.on('Network.dataReceived', (e) => { requests.get(e.requestId)?.pieces.push([e.timestamp, e.encodedDataLength]); });
  if (slow) await cdp.send('Network.emulateNetworkConditions', { offline: false, latency: LATENCY, downloadThroughput: (MBIT * 1e6) / 8, uploadThroughput: (MBIT * 1e6) / 8 });
  /** Megabytes until then, of three kinds. */
  const came = (until) => {
    const kinds = { pages: 0, splats: 0, answers: 0 };
    for (const r of requests.values()) {
      const kind = /\/(blocks\/|backdrop)/.test(r.path) ? 'splats' : r.path.startsWith('/api/') ? 'answers' : 'pages';
      for (const [at, bytes] of r.pieces) if (at <= until) kinds[kind] += bytes / 1e6;
    }
    return { all: kinds.pages + kinds.splats + kinds.answers, text: Object.entries(kinds).map(([k, v]) => `${k} ${v.toFixed(2)}`).join(', ') };
  };
  await page.goto(`${url}/#/view${process.argv[2] ? `?job=${process.argv[2]}` : ''}`, { waitUntil: 'commit' });
  await page.waitForFunction(() => globalThis.firstPicture?.finished, undefined, { timeout: 90000, polling: 30 });
  const first = await page.evaluate(() => globalThis.firstPicture);
  const then = came(began + first.finished / 1000);
  const line = slow ? `${MBIT} Mbit/s, ${LATENCY} ms` : 'this machine alone';
  console.log(`${pages.name}${line}: first picture after ${(first.finished / 1000).toFixed(2)} s (handed to the GPU after ${(first.issued / 1000).toFixed(2)} s), ${first.splats} splats, ${then.all.toFixed(2)} MB (${then.text})`);
  if (slow) await shot(page, `first-picture${pages.suffix}`);
  if (slow && process.env.TIMELINE) {
    const ms = (at) => (at === undefined ? '-' : String(Math.round((at - began) * 1000))).padStart(7);
    for (const r of requests.values()) console.log(`${ms(r.asked)}${ms(r.head)}${ms(r.pieces.at(-1)?.[0])}${String(r.pieces.reduce((n, [, bytes]) => n + bytes, 0)).padStart(9)}  ${r.path.replace(/[0-9a-f]{60,}/, '…')} ${r.range}`);
  }
  if (slow && pages.rounds.length === 0) {
    await page.waitForFunction(() => document.querySelector('[data-testid=hud]')?.dataset.pending === '0', undefined, { timeout: 90000, polling: 30 });
    await page.waitForTimeout(6000);
    console.log(`  six seconds later: ${came(Infinity).all.toFixed(2)} MB; ${(await page.locator('[data-testid=hud]').innerText()).replace(/\s+/g, ' ')}`);
    await shot(page, `first-picture-settled${pages.suffix}`);
  }
  for (const p of page.problems.filter((text) => !text.startsWith('asked another host'))) console.log(`  problem: ${p}`);
  await page.context().close();
  return { seconds: first.finished / 1000, issued: first.issued / 1000, megabytes: then.all };
}

const all = [];
for (const [i, folder] of (process.env.PAGES ?? '').split(',').entries()) all.push({ url: await front(server, folder), name: folder && `${folder}: `, suffix: i ? `-${i}` : '', rounds: [] });
await measure(all[0], false);
for (let round = 0; round < ROUNDS; round += 1) for (const pages of all) pages.rounds.push(await measure(pages, true));
const median = (values) => values.sort((x, y) => x - y)[values.length >> 1].toFixed(2);
if (ROUNDS > 1) for (const { name, rounds } of all) console.log(`${name}median of ${ROUNDS}: ${median(rounds.map((r) => r.seconds))} s (handed to the GPU after ${median(rounds.map((r) => r.issued))} s), ${median(rounds.map((r) => r.megabytes))} MB`);
await b.close();
process.exit();
