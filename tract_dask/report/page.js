(() => {
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim()

  function model(name) {
    for (const found of Bokeh.documents) {
      const one = found.get_model_by_name(name)
      if (one != null) return one
    }
    return null
  }

  function paint() {
    const ink = style("--ink"), soft = style("--soft"), line = style("--line"), card = style("--card")
    const looks = {
      Axis: {axis_label_text_color: ink, major_label_text_color: soft, axis_line_color: soft, major_tick_line_color: soft},
      Grid: {grid_line_color: line},
      Legend: {label_text_color: ink, background_fill_color: card, background_fill_alpha: 0.8, border_line_color: null},
      ColorBar: {title_text_color: ink, major_label_text_color: soft, background_fill_alpha: 0},
    }
    for (const found of Bokeh.documents) {
      for (const one of found.all_models) {
        for (const [kind, look] of Object.entries(looks)) {
          if (one.type === kind || (kind === "Axis" && one.type.endsWith("Axis"))) one.setv(look)
        }
      }
    }
  }

  function start() {
    const columns = model("columns"), choice = document.getElementById("column"), shade = document.getElementById("shade")
    const chosen = document.getElementById("chosen")
    const choose = (place) => { columns.selected.indices = [place] }
    const step = (by) => choose((Number(choice.value) + by + choice.length) % choice.length)
    choice.addEventListener("change", () => choose(Number(choice.value)))
    document.getElementById("before").addEventListener("click", () => step(-1))
    document.getElementById("after").addEventListener("click", () => step(1))
    for (const button of document.querySelectorAll(".go")) {
      button.addEventListener("click", () => {
        choose(Number(button.dataset.place))
        document.getElementById("look").scrollIntoView({behavior: "smooth"})
      })
    }
    columns.selected.properties.indices.change.connect(() => {
      const [place] = columns.selected.indices
      if (place === undefined) return
      choice.value = String(place)
      chosen.textContent = choice.options[choice.selectedIndex].text
    })
    const colour = () => {
      const option = shade.options[shade.selectedIndex]
      if (option === undefined) return
      const values = Array.from(columns.data[option.value])
      const known = values.filter(Number.isFinite).sort((a, b) => a - b)
      const high = known[Math.min(known.length - 1, Math.floor(0.98 * known.length))]
      model("shade").setv({low: known[0], high: high > known[0] ? high : known[0] + 1})
      model("shade_bar").title = option.dataset.label
      columns.data = {...columns.data, shade: values}
    }
    shade.addEventListener("change", colour)
    colour()
    choose(Number(choice.value))
    paint()
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint)
  }

  const ready = () => (window.Bokeh !== undefined && Bokeh.documents.length > 0 && model("columns") != null
    ? start() : setTimeout(ready, 30))
  ready()
})()
