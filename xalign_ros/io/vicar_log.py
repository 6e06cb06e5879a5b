"""What `xalign posegraph` says: the log in POSEGRAPH's order, and one JSON object."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from xalign_ros.core.lie import so3_log
from xalign_ros.core.tie_edges import Edge
from xalign_ros.core.tie_graph import Result
from xalign_ros.io.vicar_matrix import TITLE, matrix_lines
from xalign_ros.io.vicar_parameters import Options

LARGEST_MATRIX = 200  # images whose connectivity is printed


def log_lines(options: Options, r: Result) -> Iterator[str]:
    """Numbers of images in the words of POSEGRAPH: from 0, but from 1 where it names the reference."""
    yield f"{len(r.before)} files located from parameter INP"
    for n, view in enumerate(r.before):
        yield f"Input file {n}= {view.name}"
    yield f"{r.ties_read} tiepoints read from {options.in_tpt}"
    if options.ignore:
        yield f"{r.ignored} tiepoints ignored due to IGNORE parameter"
    if options.ignore_intra:
        yield f"{r.intra} tiepoints ignored due to IGNORE_INTRA parameter"
    for reference in r.references:
        yield f"Reference image: {reference + 1}"
    if not r.references:
        yield "No reference image"
    yield f"{r.matrix.sum()} active and valid tie-points"
    if len(r.before) <= LARGEST_MATRIX:
        yield from "".join(matrix_lines(TITLE, r.matrix)).splitlines()
    yield "Computing relative poses between all pairs"
    for edge in r.edges:
        yield f"Evaluating pair ({edge.a}, {edge.b})"
        yield f"     Baseline: {edge.baseline_m:f}"
        yield f"     Number of valid tiepoints after discarding near image edges: {edge.ties}"
        if edge.measures is not None:
            m = edge.measures
            yield (
                f"     {m.inliers} agree within {m.sigma_px:.2f} px; s0/s7 {m.condition:.0f}, median parallax "
                f"{np.rad2deg(m.parallax_rad):.2f} deg, {m.in_front:.0%} in front, {m.rotation_only:.0%} by turning alone"
            )
        if np.isfinite(edge.rotation_error_rad):
            turn, shift = np.rad2deg(edge.rotation_error_rad), edge.position_error
            yield f"     Off telemetry by {turn:.3f} deg and {shift:.1%} of the baseline"
        if sum(edge.triangles):
            yield f"     Triangles of edges: {edge.triangles[0]} close, {edge.triangles[1]} do not"
        if edge.shared:
            yield f"     Length {edge.length_m:f} m, known to {edge.length_sigma:.1%} by {edge.shared} shared points"
        yield f"     {'no edge: ' if edge.T_a_b is None else 'edge'}{edge.reason and edge.T_a_b and ': '}{edge.reason}"
    for image, ties, inliers, reason in r.anchors:
        yield f"Image {image}: {ties} known places, {reason or f'anchored by {inliers}'}"
    yield f"Images that ties connect: {_parts(r.tie_components)}"
    yield f"Images that edges connect: {_parts(r.edge_components)}"
    yield f"Number of poses: {len(r.before)}"
    yield f"Number of constraints: {sum(edge.T_a_b is not None for edge in r.edges)}"
    yield from _solve_lines(options.summary, r)


def _parts(parts: list[list[int]]) -> str:
    words = [f"{{{', '.join(map(str, part[:20]))}{', ...' if len(part) > 20 else ''}}}" for part in parts[:50]]
    return " ".join(words) + (f" and {len(parts) - 50} more" if len(parts) > 50 else "")


def _solve_lines(summary: str, r: Result) -> Iterator[str]:
    s = r.solution
    if s is None or summary == "NO_SUM":
        yield "" if s else "No edge, so every image keeps its pose"
        return
    end = "CONVERGENCE" if s.converged else "NO_CONVERGENCE"
    yield (
        f"Solver Report: Iterations: {s.iterations}, Initial cost: {s.initial_cost:e}, Final cost: {s.cost:e}, "
        f"Termination: {end}"
    )
    if s.gauge:
        yield f"Held: {s.gauge}"
    if summary == "FULL_SUM":
        for n, turn, shift in _moves(r):
            yield f"     Image {n}: turned {np.rad2deg(turn):.4f} deg, moved {shift:.5f} m"


def _moves(r: Result) -> Iterator[tuple[int, float, float]]:
    for n, (old, new) in enumerate(zip(r.before, r.after, strict=True)):
        turn = float(np.linalg.norm(so3_log(old.T_site_body.R.T @ new.T_site_body.R)))
        yield n, turn, float(np.linalg.norm(new.T_site_body.t - old.T_site_body.t))


def as_json(r: Result) -> dict[str, Any]:
    """Numbers of images from 0."""
    s = r.solution
    return {
        "images": [view.name for view in r.before],
        "ties": r.ties_read,
        "ties_used": int(r.matrix.sum()),
        "ties_ignored": r.ignored + r.intra,
        "ties_unsupported": r.unsupported,
        "references": list(r.references),
        "tie_components": r.tie_components,
        "edge_components": r.edge_components,
        "pairs": [_pair(edge) for edge in r.edges],
        "anchors": [{"image": i, "ties": n, "inliers": k, "reason": why} for i, n, k, why in r.anchors],
        "edges": sum(edge.T_a_b is not None for edge in r.edges),
        "initial_cost": s.initial_cost if s else 0.0,
        "cost": s.cost if s else 0.0,
        "iterations": s.iterations if s else 0,
        "converged": s.converged if s else True,
        "gauge": s.gauge if s else "",
        "moved": [{"deg": float(np.rad2deg(turn)), "m": shift} for _, turn, shift in _moves(r)],
        "notes": list(r.notes),
    }


def _pair(edge: Edge) -> dict[str, Any]:
    m = edge.measures
    out: dict[str, Any] = {"images": [edge.a, edge.b], "edge": edge.T_a_b is not None, "reason": edge.reason}
    out |= {"ties": edge.ties, "baseline_m": edge.baseline_m}
    if np.isfinite(edge.rotation_error_rad):
        turn = float(np.rad2deg(edge.rotation_error_rad))
        out |= {"off_telemetry_deg": turn, "off_telemetry_baselines": edge.position_error}
    if edge.found is not None:
        out |= {"length_m": edge.length_m, "length_sigma": edge.length_sigma, "shared_points": edge.shared}
        out |= {"triangles_closed": edge.triangles[0], "triangles_open": edge.triangles[1]}
    if m is not None:
        out |= {
            "inliers": m.inliers,
            "sigma_px": m.sigma_px,
            "condition": m.condition if np.isfinite(m.condition) else None,
            "parallax_deg": float(np.rad2deg(m.parallax_rad)),
            "in_front": m.in_front,
            "rotation_only": m.rotation_only,
        }
    return out
