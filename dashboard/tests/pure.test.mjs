// The decisions that are functions over plain data: the cut of the tree, the front, the folding of problems.
import assert from 'node:assert/strict';
import { join } from 'node:path';
import { test } from 'node:test';
import { build } from 'vite';

async function load(path) {
  const entry = join(import.meta.dirname, '..', 'src', path);
  const built = await build({ configFile: false, logLevel: 'silent', build: { write: false, minify: false, lib: { entry, formats: ['es'] } } });
  const { code } = built[0].output[0];
  return import(`data:text/javascript;base64,${Buffer.from(code).toString('base64')}`);
}

test('the cut', async () => {
  const { tree, cut } = await load('viewer/cut.ts');
  const root = { x: 0, y: 0, edge: 800 };
  const block = (name, done = true, splats = 100) => ({ block: name, task: 0, artefact: done ? name : null, splats, rho_metres: 0.64 / 2 ** Number(name[0]), box: null, backdrop: false });
  const names = ['0/0/0', '1/0/0', '1/1/0', '1/0/1', '1/1/1', '2/0/0', '2/1/0', '2/0/1', '2/1/1'];
  const eye = { at: [50, 50, 30], forward: [0.7, 0.7, 0] };
  const drawn = (blocks, budget) => [...cut(tree(blocks), root, eye, budget).masks].map(([n, mask]) => `${n.block.block}:${mask}`).sort();
  // All done and affordable: the leaves, nothing else.
  assert.deepEqual(drawn(names.map((n) => block(n)), 1e6), ['1/0/1:0', '1/1/0:0', '1/1/1:0', '2/0/0:0', '2/0/1:0', '2/1/0:0', '2/1/1:0']);
  // A block that is not finished: its parent stands in for that quarter only.
  assert.deepEqual(drawn(names.map((n) => block(n, n !== '2/1/1')), 1e6), ['1/0/0:7', '1/0/1:0', '1/1/0:0', '1/1/1:0', '2/0/0:0', '2/0/1:0', '2/1/0:0']);
  assert.deepEqual(drawn(names.map((n) => block(n, n === '0/0/0')), 1e6), ['0/0/0:0']);
  assert.deepEqual(drawn(names.map((n) => block(n, false)), 1e6), []);
  // A budget for little: the quarter around the eye is handed on first.
  assert.deepEqual(drawn(names.map((n) => block(n)), 180), ['0/0/0:1', '1/0/0:0']);
  // However small the budget, something is drawn.
  assert.deepEqual(drawn(names.map((n) => block(n)), 1), ['0/0/0:0']);
});

test('where drawn blocks meet', async () => {
  const { tree, meeting } = await load('viewer/cut.ts');
  const block = (name) => ({ block: name, task: 0, artefact: name, splats: 1, rho_metres: 1, box: null, backdrop: false });
  const at = Object.fromEntries(tree(['0/0/0', '1/0/0', '1/1/0', '1/0/1', '1/1/1', '2/2/0'].map(block)).map((n) => [n.block.block, n]));
  const faces = (...drawn) => meeting(new Map(drawn.map(([name, mask]) => [at[name], mask])), { x: 0, y: 0, edge: 8 })
    .map(({ a, b, from, to }) => `${a.block.block} ${b.block.block} ${from} ${to}`).sort();
  // Four quarters: four faces, and none where only corners touch.
  assert.deepEqual(faces(['1/0/0', 0], ['1/1/0', 0], ['1/0/1', 0], ['1/1/1', 0]),
    ['1/0/0 1/0/1 0,4 4,4', '1/0/0 1/1/0 4,0 4,4', '1/0/1 1/1/1 4,4 4,8', '1/1/0 1/1/1 4,4 8,4']);
  // A block that stands in for three quarters meets the child in the fourth, and no quarter of its own.
  assert.deepEqual(faces(['0/0/0', 1], ['1/0/0', 0]), ['0/0/0 1/0/0 0,4 4,4', '0/0/0 1/0/0 4,0 4,4']);
  // Of different sizes: the part where both are.
  assert.deepEqual(faces(['1/0/0', 0], ['2/2/0', 0]), ['1/0/0 2/2/0 4,0 4,2']);
});

test('the front', async () => {
  const { runs, front, dominator, mainSplit, csv } = await load('widgets/front.ts');
  const run = (label, cpu_seconds, psnr, more = {}) => ({ label, scene: 's', source: null, split: 'a', cpu_seconds, wall_seconds: cpu_seconds, psnr, ssim: null, perceptual: null, ...more });
  const all = [run('fast', 10, 24), run('beaten', 30, 23), run('good', 40, 27), run('best', 90, 28), run('paper', 5, 40, { source: 'a paper' }), run('other', 6, 39, { split: 'b' }), run('no time', null, 30)];
  const points = runs(all, 'cpu_seconds', 'psnr');
  assert.equal(mainSplit(all), 'a');
  const line = front(points, 'a');
  assert.deepEqual(line.map((p) => p.r.label), ['fast', 'good', 'best']);
  assert.equal(dominator(points[1], line).r.label, 'fast');
  assert.equal(dominator(points[2], line), null);
  assert.equal(csv([run('a, "b"', 1, 2)]).split('\n')[1].startsWith('"a, ""b""",s,a'), true);
});
