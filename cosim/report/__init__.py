"""The drawing kit of every page: plots, tables, templates. It knows no subject."""
