"""The paper's figures from any run: one small module a figure, one table of them."""
