"""Reports: how are results written down? metrics.json, HTML, figures, comparisons."""
