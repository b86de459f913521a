"""Speed against error: what each knob of each stage costs, and what error it leaves.

Each stage is a module that measures its knobs on a :class:`~engine.accuracy.subject.Subject` against a reference that
is made another way. Errors are the same for the same realization; costs are measured, in CPU seconds of one thread.
Nothing that computes a result imports this package.
"""
