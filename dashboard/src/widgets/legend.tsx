// What the map's colours mean: a glyph or a hatch and a word beside each colour.
import { GLYPHS, ramp, stateColours, workerColour } from '../colours';
import { count, fixed } from '../format';
import { NAMES, version, type TaskTable } from '../tasks';
import { extent, type Look } from './mapdraw';

export function Legend({ table, look }: { table: TaskTable; look: Look }) {
  return (
    <div class="legend">
      {look.by === 'state' ? <States table={table} /> : look.by === 'worker' ? <Names table={table} /> : <Ramp table={table} look={look} />}
      {look.cameras && <span><i class="key" style={{ background: 'var(--camera)', width: '5px', height: '5px' }} />camera</span>}
      {look.cameras && <span><i class="key" style={{ background: 'var(--camera-test)', width: '5px', height: '5px' }} />held-out camera</span>}
    </div>
  );
}

function States({ table }: { table: TaskTable }) {
  void version.value;
  const colours = stateColours();
  const n = NAMES.map(() => 0);
  for (let i = 0; i < table.blocks; i += 1) n[table.state[i]!]! += 1;
  return (
    <>
      {NAMES.map((name, s) => (
        <span key={name}><i class={`key ${s === 4 ? 'hatch' : s === 5 ? 'cross' : ''}`} aria-hidden="true" style={{ backgroundColor: colours[s], color: s < 2 ? 'var(--on-light)' : '#fff' }}>{GLYPHS[s]}</i>
          {name} <span class="num">{n[s]}</span></span>
      ))}
    </>
  );
}

function Ramp({ table, look }: { table: TaskTable; look: Look }) {
  void version.value;
  const [low, high] = extent(table, look);
  const format = look.by === 'psnr' ? (v: number) => `${fixed(v, 1)} dB` : look.by === 'speed' ? (v: number) => `${fixed(v, 1)} steps/s` : count;
  const stops = [0, 0.25, 0.5, 0.75, 1].map(ramp).join(',');
  return (
    <>
      <span class="num">{format(low)}</span>
      <i class="ramp" style={{ background: `linear-gradient(90deg, ${stops})` }} aria-hidden="true" />
      <span class="num">{format(high)}</span>
      <span>{look.by === 'speed' ? 'running blocks only' : 'without a value: not coloured'}</span>
    </>
  );
}

function Names({ table }: { table: TaskTable }) {
  void version.value;
  const names = [...new Set(table.worker)].filter((w) => w !== '').sort();
  return (
    <>
      {names.slice(0, 12).map((name) => <span key={name}><i class="key" aria-hidden="true" style={{ backgroundColor: workerColour(name) }} />{name}</span>)}
      {names.length > 12 && <span>and {names.length - 12} more: names appear when zoomed in</span>}
    </>
  );
}
