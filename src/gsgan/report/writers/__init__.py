"""A report as text: Markdown, LaTeX, HTML, JSON, and the terminal."""
