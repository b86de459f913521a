// What changes by itself: a grid's progress with its stream of events, at most once a second, and a bar that
// fills while htmx fetches. Without this script a page is as it was when it was loaded.
(() => {
  const part = document.querySelector("[data-events]");
  if (!part || !window.EventSource) return;
  const stream = new EventSource(part.dataset.events);
  let due = null, last = 0;
  const tell = () => { due = null; last = Date.now(); htmx.trigger(document.getElementById("live"), "changed"); };
  const soon = () => { if (due === null) due = setTimeout(tell, Math.max(0, last + 1000 - Date.now())); };
  for (const kind of part.dataset.kinds.split(" ")) stream.addEventListener(kind, soon);
  stream.addEventListener("grid_finished", () => {
    stream.close();
    // The whole page once more: what may be done is something else now, and there are figures.
    setTimeout(() => location.reload(), 800);
  });
  // What came while nobody listened.
  stream.addEventListener("open", soon);
  stream.addEventListener("error", soon);
  addEventListener("pagehide", () => stream.close());
})();
