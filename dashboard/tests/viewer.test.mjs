// The viewer draws splats of finished blocks within its budget, and says why where it cannot.
import assert from 'node:assert/strict';
import { test } from 'node:test';
import { browser, mock, open, REAL, shot } from './helper.mjs';

test('the viewer', async (t) => {
  const b = await browser();
  const server = REAL ? { url: REAL, stop: async () => {} } : await mock('demo');
  // A software GPU draws: the window is small and the budget the least.
  const small = { viewport: { width: 760, height: 560 } };
  await t.test('draws the cut within its budget', async () => {
    const page = await open(b, `${server.url}/#/view?budget=20000`, small);
    await page.waitForFunction(() => Number(document.querySelector('[data-testid=hud]')?.dataset.shown) > 500, undefined, { timeout: 30000 });
    await page.waitForFunction(() => document.querySelector('[data-testid=hud]').dataset.pending === '0', undefined, { timeout: 20000 });
    const hud = await page.locator('[data-testid=hud]').evaluate((e) => ({ ...e.dataset }));
    console.log(`viewer: ${hud.shown} splats of ${hud.blocks} blocks`);
    assert.ok(Number(hud.shown) <= 20000 * 1.1 && Number(hud.blocks) >= 1);
    await shot(page, 'viewer');
    if (!REAL) assert.ok((await page.locator('.labels span').count()) > 0, 'blocks not finished have a label');
    await page.getByLabel('outlines').check();
    await page.getByLabel('levels').check();
    await page.waitForTimeout(2500);
    await shot(page, 'viewer-levels');
    if (!REAL) {
      await page.selectOption('.tools select', '3');
      await page.waitForSelector('.wipe img');
      await page.waitForTimeout(2500);
      await shot(page, 'viewer-photo');
      await page.selectOption('.tools select', '');
      await page.getByLabel('before pruning').check();
      await page.waitForSelector('text=pruned');
      await page.waitForTimeout(2500);
      assert.equal(await page.locator('.viewer canvas').count(), 2);
      await shot(page, 'viewer-before');
    }
    assert.deepEqual(page.problems, []);
    await page.context().close();
  });
  await t.test('without WebGL2: the reason and the files', async () => {
    const page = await open(b, 'about:blank', small);
    page.problems = [];
    await page.addInitScript(() => {
      const ask = HTMLCanvasElement.prototype.getContext;
      HTMLCanvasElement.prototype.getContext = function context(kind, ...rest) { return kind === 'webgl2' ? null : ask.call(this, kind, ...rest); };
    });
    await page.goto(`${server.url}/#/view`);
    await page.waitForSelector('text=could not start it');
    if (!REAL) await page.waitForSelector('a:has-text("merged.ply")');
    await shot(page, 'viewer-no-webgl');
    await page.context().close();
  });
  await b.close();
  await server.stop();
});
