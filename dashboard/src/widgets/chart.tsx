// A line chart (uPlot) that follows its box, the theme and the data.
import uPlot from 'uplot';
import 'uplot/dist/uPlot.min.css';
import { useEffect, useRef } from 'preact/hooks';
import { useSignal } from '@preact/signals';
import { css } from '../colours';
import { dark } from '../settings';

export interface Line {
  label: string;
  values: (number | null)[];
  colour: string;
  dash?: number[];
  points?: boolean;
  thin?: boolean;
}

interface Props {
  title: string;
  x: number[];
  xLabel: string;
  lines: Line[];
  /** Two lines, by index, between which is filled. */
  band?: [high: number, low: number];
  log?: boolean;
  height?: number;
  format: (v: number) => string;
}

export function Chart(props: Props) {
  const { title, x, xLabel, lines, band, log, height = 190, format } = props;
  const box = useRef<HTMLDivElement>(null);
  const chart = useRef<uPlot | null>(null);
  const asTable = useSignal(false);
  const shape = `${lines.map((l) => l.label).join()} ${log} ${dark.value} ${asTable.value}`;

  useEffect(() => {
    const here = box.current;
    if (!here || asTable.value) return undefined;
    const axis = { stroke: css('muted'), grid: { stroke: css('line'), width: 1 }, ticks: { stroke: css('line'), width: 1 }, font: '11px system-ui, sans-serif' };
    const made = new uPlot({
      width: here.clientWidth || 300, height,
      scales: { x: { time: false }, y: log ? { distr: 3 } : {} },
      legend: { live: true },
      cursor: { points: { size: 6 } },
      series: [
        { label: xLabel },
        ...lines.map((l) => ({
          label: l.label, stroke: l.colour, width: l.dash || l.thin ? 1 : 1.75, dash: l.dash, spanGaps: true, points: { show: l.points ?? false, size: 5 },
          value: (_: uPlot, v: number | null) => (v == null ? '–' : format(v)),
        })),
      ],
      bands: band ? [{ series: [band[0] + 1, band[1] + 1], fill: css('band') }] : [],
      axes: [{ ...axis, size: 30 }, { ...axis, size: 54, values: (_: uPlot, ticks: (number | null)[]) => ticks.map((v) => (v == null ? '' : format(v))) }],
    }, data(props), here);
    chart.current = made;
    const sizes = new ResizeObserver(() => made.setSize({ width: here.clientWidth, height }));
    sizes.observe(here);
    return () => { sizes.disconnect(); made.destroy(); chart.current = null; };
  }, [shape, height]);
  useEffect(() => { chart.current?.setData(data(props)); }, [x, lines]);

  return (
    <figure class="chart">
      <figcaption>{title}<button type="button" class="quiet" aria-pressed={asTable.value} onClick={() => { asTable.value = !asTable.value; }}>{asTable.value ? 'Chart' : 'Table'}</button></figcaption>
      {asTable.value ? <Numbers {...props} /> : <div ref={box} role="img" aria-label={`${title}: ${x.length} points. The table button shows the numbers.`} />}
    </figure>
  );
}

function data({ x, lines }: Props): uPlot.AlignedData {
  return [x, ...lines.map((l) => l.values)] as uPlot.AlignedData;
}

function Numbers({ x, xLabel, lines, format, height = 190 }: Props) {
  return (
    <div class="scroll" style={{ maxHeight: `${height + 30}px` }} tabIndex={0}>
      <table class="plain">
        <thead><tr><th>{xLabel}</th>{lines.map((l) => <th key={l.label}>{l.label}</th>)}</tr></thead>
        <tbody>{x.map((at, i) => <tr key={i}><td>{+at.toFixed(2)}</td>{lines.map((l) => <td key={l.label}>{l.values[i] == null ? '–' : format(l.values[i]!)}</td>)}</tr>)}</tbody>
      </table>
    </div>
  );
}
