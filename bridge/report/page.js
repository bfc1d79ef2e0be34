"use strict";
// Draws every figure of the page from the data that stands inside it.
document.querySelectorAll(".plot").forEach(function (place) {
  const given = JSON.parse(place.querySelector("script").textContent);
  const config = { responsive: true, displaylogo: false, displayModeBar: false };
  place.textContent = "";
  const drawn = Plotly.newPlot(place, given.data, given.layout, config);
  // paper is narrower than most screens: draw for it, and for the screen again afterwards
  window.addEventListener("beforeprint", function () {
    Plotly.relayout(place, { width: 680 });
  });
  window.addEventListener("afterprint", function () {
    Plotly.relayout(place, { width: null, autosize: true });
  });
  drawn.then(function () { place.dataset.drawn = "yes"; });
  place.parentElement.querySelectorAll("select").forEach(function (menu) {
    menu.addEventListener("change", function () {
      const axis = menu.dataset.axis;
      const choice = given.choices[axis][Number(menu.value)];
      const layout = {};
      layout[axis + "axis.title.text"] = choice.title;
      layout[axis + "axis.autorange"] = true;
      const data = {};
      data[axis] = choice.values;
      Plotly.update(place, data, layout);
    });
  });
});
