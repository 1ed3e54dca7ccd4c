"""The scores of a run as text for a terminal."""

from __future__ import annotations


def table(metrics: dict) -> str:
    """The errors of metrics.json as a table, MSE x100 [m^2]: closed form, temporal and ours."""
    titles = {"closed_form": "closed form", "temporal": "temporal", "d": "d"}
    titles |= {"d_normalised": "d / opacity", "d_median": "median", "d_tof": "d_ToF"}
    lines = [f"{'MSE x100 [m^2]':<16}" + "".join(f"{title:>13}" for title in titles.values())]
    for name in ("all", "moving", "static"):
        row = (metrics if name == "all" else metrics[name]) or {}
        values = [row.get(f"{key}_mse_x100") for key in titles]
        cells = ["-" if value is None else f"{value:.4g}" for value in values]
        lines.append(f"{name:<16}" + "".join(f"{cell:>13}" for cell in cells))
    psnr = metrics["quad_psnr_db"]
    quality = "-" if psnr is None else f"{psnr:.2f} dB"
    scored = f"{metrics['frames']} raw frames ({metrics['protocol']})"
    lines.append(f"{scored}, against {metrics.get('against', 'geometry')}, quad PSNR {quality}")
    if (explained := metrics.get("explained")) is not None:
        lines.append(_explained(explained))
    share = metrics.get("ambiguous_share")
    if share is not None:
        reach = f"{metrics['unambiguous_range_m']:.4g} m by several frequencies together"
        lines.append(f"unambiguous to {reach}; {share:.1%} of the closed form ambiguous")
    return "\n".join(lines)


def _explained(explained: dict) -> str:
    """How well the quads are explained, in a line."""
    known = {
        "reduced chi-square of the quads": ("reduced_chi_square", "{:.3g}"),
        "pixels not explained": ("unexplained_share", "{:.1%}"),
        "of those that change": ("changing_unexplained_share", "{:.1%}"),
        "of the others at a wrong distance": ("contradicted_share", "{:.1%}"),
    }
    values = {name: (explained[key], form) for name, (key, form) in known.items()}
    return ", ".join(
        f"{name} {form.format(v)}" for name, (v, form) in values.items() if v is not None
    )
