"""The interior term: the derivative of what is smooth along every path."""
