"""The studio: a page in the browser, from one local server, in which a bench is explained with the mouse."""
