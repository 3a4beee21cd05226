"""The documentation: Markdown pages, the pages of the public names, and the commands that make the site."""
