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
    }
    await page.getByLabel('outlines').uncheck();
    await page.getByLabel('missing blocks').uncheck();
    await page.getByLabel('levels').uncheck();
    await page.getByRole('button', { name: 'Show all' }).click();
    await page.getByLabel('seams').check();
    await page.getByLabel('Budget').fill('4.8');
    await page.waitForTimeout(2500);
    await shot(page, 'viewer-seams');
    if (!REAL) assert.match((await page.locator('.labels').innerText()), /^\d+\.\d$/m, 'faces that were measured have a label');
    assert.deepEqual(page.problems, []);
    await page.context().close();
  });
  if (!REAL) await t.test('compares two jobs by a wipe', async () => {
    const several = await mock('several');
    const page = await open(b, `${several.url}/#/view?job=1&budget=20000`, small);
    await page.waitForFunction(() => Number(document.querySelector('[data-testid=hud]')?.dataset.shown) > 500, undefined, { timeout: 30000 });
    await page.getByLabel('Compare with').selectOption('2');
    await page.waitForFunction(() => Number(document.querySelector('[data-testid=compare]')?.dataset.shown) > 500, undefined, { timeout: 30000 });
    assert.equal(await page.locator('.viewer canvas').count(), 2);
    await page.getByLabel('Wipe between job 2').fill('30');
    await page.waitForTimeout(1500);
    assert.match(await page.locator('.viewer canvas').nth(1).getAttribute('style'), /inset\(0px 70% 0px 0px\)/);
    await shot(page, 'viewer-compare');
    await page.getByLabel('Compare with').selectOption('');
    await page.waitForSelector('[data-testid=compare]', { state: 'detached' });
    assert.deepEqual(page.problems, []);
    await page.context().close();
    await several.stop();
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
