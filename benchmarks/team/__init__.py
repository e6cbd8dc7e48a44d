"""Several robots that explore one world together, against one robot and against trouble."""
