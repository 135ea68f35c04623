"""Generated code of one scheme for dofs of given orders, compiled once for a signature."""
