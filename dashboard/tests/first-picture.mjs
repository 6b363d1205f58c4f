// How soon the viewer shows something, over a slow line: 20 Mbit/s and 50 ms, by Chromium's own emulation.
//   URL=http://127.0.0.1:7420 node tests/first-picture.mjs [MODEL'S JOB]        PAGES=dist tries this folder's pages
// Says when the first frame with splats was drawn and when all of the cut was, what had come by then, and how long the browser's own work took.
import { front } from './cluster.mjs';
import { browser, open, shot } from './helper.mjs';

const [MBIT, LATENCY] = [Number(process.env.MBIT ?? 20), 50];
const url = await front(process.env.URL ?? 'http://127.0.0.1:7288');
const b = await browser();

async function measure(slow) {
  const page = await open(b, 'about:blank', { viewport: { width: 1280, height: 800 } });
  page.problems = [];
  const cdp = await page.context().newCDPSession(page);
  await cdp.send('Network.enable');
  const kinds = { pages: 0, answers: 0, splats: 0 };
  const urls = new Map();
  cdp.on('Network.requestWillBeSent', (e) => urls.set(e.requestId, e.request.url));
  cdp.on('Network.dataReceived', (e) => {
    const from = urls.get(e.requestId) ?? '';
    kinds[/\/(blocks|backdrop)/.test(from) && !from.includes('#') ? 'splats' : from.includes('/api/') ? 'answers' : 'pages'] += e.encodedDataLength;
  });
  if (slow) await cdp.send('Network.emulateNetworkConditions', { offline: false, latency: LATENCY, downloadThroughput: (MBIT * 1e6) / 8, uploadThroughput: (MBIT * 1e6) / 8 });
  const began = Date.now();
  await page.goto(`${url}/#/view${process.argv[2] ? `?job=${process.argv[2]}` : ''}`, { waitUntil: 'commit' });
  const hud = (check) => page.waitForFunction(check, undefined, { timeout: 90000, polling: 30 });
  const at = async (what, check) => {
    await hud(check);
    const marks = await page.evaluate(() => ({ ...document.querySelector('[data-testid=hud]').dataset }));
    const bytes = kinds.pages + kinds.answers + kinds.splats;
    console.log(`${slow ? `${MBIT} Mbit/s, ${LATENCY} ms` : 'this machine alone'}: ${what} after ${((Date.now() - began) / 1000).toFixed(2)} s, ${(bytes / 1e6).toFixed(2)} MB (pages ${(kinds.pages / 1e6).toFixed(2)}, splats ${(kinds.splats / 1e6).toFixed(2)}, answers ${(kinds.answers / 1e6).toFixed(2)}), ${marks.shown} splats of ${marks.blocks} blocks`);
  };
  await at('first frame with splats', () => Number(document.querySelector('[data-testid=hud]')?.dataset.shown) > 0);
  if (slow) await shot(page, 'first-picture');
  await at('nothing pending', () => document.querySelector('[data-testid=hud]').dataset.pending === '0');
  await page.waitForTimeout(6000);
  await at('six seconds later', () => true);
  const hudText = await page.locator('[data-testid=hud]').innerText();
  console.log(`  ${hudText.replace(/\s+/g, ' ')}`);
  if (slow) await shot(page, 'first-picture-settled');
  for (const p of page.problems.filter((text) => !text.startsWith('asked another host'))) console.log(`  problem: ${p}`);
  await page.context().close();
}

await measure(false);
await measure(true);
await b.close();
process.exit();
