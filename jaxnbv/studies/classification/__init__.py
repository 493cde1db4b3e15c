"""Which class is the object of? The paper's experiments on classification, one a module."""
