// Copy buttons, and larger images: the page is complete without them.
for (const pre of document.querySelectorAll('.copybox pre')) {
  const button = document.createElement('button');
  button.textContent = 'Copy';
  button.onclick = async () => {
    getSelection().selectAllChildren(pre.firstElementChild);
    try { await navigator.clipboard.writeText(pre.textContent); } catch { document.execCommand('copy'); }
    button.textContent = 'Copied';
  };
  pre.after(button);
}
const large = document.createElement('dialog');
large.setAttribute('aria-label', 'Larger images');
large.onclick = () => large.close();
document.body.append(large);
for (const row of document.querySelectorAll('.row')) {
  const open = () => {
    const close = document.createElement('button');
    close.textContent = 'Close';
    large.replaceChildren(row.cloneNode(true), close);
    large.showModal();
  };
  row.onclick = open;
  row.onkeydown = event => { if (event.key === 'Enter' || event.key === ' ') { event.preventDefault(); open(); } };
  row.setAttribute('role', 'button');
  row.tabIndex = 0;
  row.title = 'Enlarge';
}
// Only what can be scrolled is a stop of the Tab key.
const stops = () => {
  for (const wide of document.querySelectorAll('.wide')) wide.tabIndex = wide.scrollWidth > wide.clientWidth ? 0 : -1;
};
stops();
addEventListener('resize', stops);
addEventListener('toggle', stops, true);
// The tables of a study are printed.
const folded = [...document.querySelectorAll('#study > details:not([open])')];
addEventListener('beforeprint', () => folded.forEach(table => { table.open = true; }));
addEventListener('afterprint', () => folded.forEach(table => { table.open = false; }));
