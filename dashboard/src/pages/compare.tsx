export function Compare() { return <div class="empty">Compare</div>; }
