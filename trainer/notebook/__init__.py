"""The steps from captures to a bundle as Python functions, with results that show themselves in a notebook.

`hololoop` at the top of the project names what is public of them.
"""
