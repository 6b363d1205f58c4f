// A small curve without axes: held-out PSNR of a job while it trained, on the first page, where no chart library is loaded.
import type { Curve } from '../api';
import { fixed, span } from '../format';

const [W, H, PAD] = [420, 84, 6];

export function QualityCurve({ curve }: { curve: Curve }) {
  const { cpu_seconds: x, psnr: y } = curve;
  if (x.length < 2) return <div class="empty">{x.length ? `${fixed(y[0], 2)} dB after ${span(x[0])}; the curve begins with a second measurement.` : 'Nothing is measured yet.'}</div>;
  const [low, high] = [Math.min(...y), Math.max(...y)];
  const range = Math.max(high - low, 0.1);
  const px = (v: number): number => PAD + (v / x.at(-1)!) * (W - 2 * PAD);
  const py = (v: number): number => H - PAD - ((v - low) / range) * (H - 2 * PAD);
  const points = x.map((v, i) => `${px(v).toFixed(1)},${py(y[i]!).toFixed(1)}`);
  return (
    <div class="spark">
      <svg viewBox={`0 0 ${W} ${H}`} preserveAspectRatio="none" role="img" aria-label={`Held-out PSNR from ${fixed(y[0], 2)} to ${fixed(y.at(-1), 2)} dB in ${span(x.at(-1))} of CPU time`}>
        <polyline points={points.join(' ')} fill="none" stroke="var(--c1)" stroke-width="2" vector-effect="non-scaling-stroke" />
      </svg>
      <p class="num"><span>{fixed(y[0], 2)} dB after {span(x[0])}</span><b>{fixed(y.at(-1), 2)} dB after {span(x.at(-1))} of CPU time</b></p>
    </div>
  );
}
