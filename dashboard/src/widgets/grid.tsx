// A sortable table that keeps only the rows on screen in the page, so that 10,000 rows cost what 40 cost.
import type { ComponentChildren } from 'preact';
import { useLayoutEffect, useMemo, useRef } from 'preact/hooks';
import { useSignal } from '@preact/signals';

export interface Column {
  key: string;
  title: string;
  width: string;
  /** Numbers to the right. */
  number?: boolean;
  /** What to sort by; NaN and null go last. */
  by: (row: number) => number | string | null;
  cell: (row: number) => ComponentChildren;
}

interface Props {
  label: string;
  rows: ArrayLike<number>;
  columns: Column[];
  sort: string;
  descending?: boolean;
  /** Changes when the rows' values did. */
  version: unknown;
  height: number;
  onOpen?: (row: number) => void;
  chosen?: (row: number) => boolean;
}

const ROW = 28;

export function Grid({ label, rows, columns, sort, descending, version, height, onOpen, chosen }: Props) {
  const order = useSignal({ key: sort, down: descending ?? false });
  const top = useSignal(0);
  const box = useRef<HTMLDivElement>(null);
  const { key, down } = order.value;
  const column = columns.find((c) => c.key === key) ?? columns[0]!;
  const sorted = useMemo(() => sortRows(rows, column.by, down), [rows, key, down, version]);
  const visible = Math.max(2, Math.ceil(height / ROW));
  const first = Math.max(0, Math.min(sorted.length - visible, Math.floor(top.value / ROW)) - 8);
  const last = Math.min(sorted.length, first + visible + 16);
  const template = columns.map((c) => c.width).join(' ');
  useLayoutEffect(() => { if (box.current) box.current.scrollTop = 0; top.value = 0; }, [key, down]);

  const keys = (e: KeyboardEvent, row: number): void => {
    const here = e.currentTarget as HTMLElement;
    if (e.key === 'Enter' && onOpen) onOpen(row);
    else if (e.key === 'ArrowDown') (here.nextElementSibling as HTMLElement | null)?.focus();
    else if (e.key === 'ArrowUp') (here.previousElementSibling as HTMLElement | null)?.focus();
    else return;
    e.preventDefault();
  };

  return (
    <div class="grid" role="table" aria-label={label} aria-rowcount={sorted.length + 1}>
      <div role="rowgroup">
        <div role="row" class="grid-head" style={{ gridTemplateColumns: template }} aria-rowindex={1}>
          {columns.map((c) => (
            <div key={c.key} role="columnheader" class={c.number ? 'n' : ''} aria-sort={c.key === key ? (down ? 'descending' : 'ascending') : 'none'}>
              <button type="button" onClick={() => { order.value = { key: c.key, down: c.key === key ? !down : !!c.number }; }}>
                {c.title}<span aria-hidden="true">{c.key === key ? (down ? ' ▾' : ' ▴') : ''}</span>
              </button>
            </div>
          ))}
        </div>
      </div>
      <div ref={box} role="rowgroup" class="grid-body" tabIndex={0} aria-label={`${label}: rows`} style={{ maxHeight: `${height}px` }}
        onScroll={(e) => { top.value = (e.currentTarget as HTMLElement).scrollTop; }}>
        <div role="presentation" style={{ height: `${first * ROW}px` }} />
        {sorted.subarray(first, last).reduce<ComponentChildren[]>((out, row, k) => {
          out.push(
            <div key={row} role="row" class={`grid-row${onOpen ? ' opens' : ''}${chosen?.(row) ? ' chosen' : ''}`} style={{ gridTemplateColumns: template }} aria-rowindex={first + k + 2}
              tabIndex={onOpen ? 0 : undefined} onClick={onOpen && (() => onOpen(row))} onKeyDown={onOpen && ((e) => keys(e, row))}>
              {columns.map((c) => <div key={c.key} role="cell" class={c.number ? 'n' : ''}>{c.cell(row)}</div>)}
            </div>,
          );
          return out;
        }, [])}
        <div role="presentation" style={{ height: `${(sorted.length - last) * ROW}px` }} />
      </div>
    </div>
  );
}

function sortRows(rows: ArrayLike<number>, by: Column['by'], down: boolean): Uint32Array {
  const list = Array.from(rows, (row) => ({ row, value: by(row) }));
  const missing = (v: number | string | null): boolean => v === null || (typeof v === 'number' && Number.isNaN(v));
  list.sort((a, b) => {
    const [am, bm] = [missing(a.value), missing(b.value)];
    if (am || bm) return Number(am) - Number(bm) || a.row - b.row;
    const less = a.value! < b.value! ? -1 : a.value! > b.value! ? 1 : 0;
    return (down ? -less : less) || a.row - b.row;
  });
  return Uint32Array.from(list, (l) => l.row);
}
