
// Interactive parts of a report: 3-D views, and menus that choose a drawing.
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);
for (const canvas of document.querySelectorAll('canvas.view')) {
  new View(canvas, JSON.parse(canvas.nextElementSibling.textContent), colour);
}
for (const gallery of document.querySelectorAll('.gallery')) {
  const menus = [...gallery.querySelectorAll('select')];
  const drawings = [...gallery.querySelectorAll('.drawings')];
  const show = () => {
    const chosen = menus.reduce((place, m) => place * m.options.length + m.selectedIndex, 0);
    drawings.forEach((drawing, i) => { drawing.hidden = i !== chosen; });
  };
  menus.forEach((menu) => menu.addEventListener('change', show));
  show();  // the browser restores the menus on a reload
}
document.documentElement.dataset.drawn = 'yes';
