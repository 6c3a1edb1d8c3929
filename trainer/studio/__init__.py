"""The studio: a page in the browser on which a bench is explained with the mouse."""
