"""What ``canductor can doctor`` looks at: pure functions from facts to findings.

``facts`` says what is known, ``interface``, ``traffic`` and ``population`` judge it, ``known_faults`` holds
what is publicly known of kernels and adapters. Nothing here reads, sends or waits.
"""
