"""A figure as values, and what draws it: plotly for pages, matplotlib for files."""
