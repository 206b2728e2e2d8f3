"""Colours and strokes that the pictures share."""

from matplotlib import patheffects

# Blue and vermilion of Okabe and Ito: told apart also by those who do not see red or green.
COLOURS = {"appeared": "#0072B2", "disappeared": "#D55E00"}
HALO = [patheffects.withStroke(linewidth=2.5, foreground="white")]
