"""The experiment: a plan of sequences and estimators, run, measured, compared and written down.

`plan` has what to compare, `jobs` what that means run by run, `worker` does one run, `engines` do many, `store` keeps
the results, `statistics` judges them, `report` shows them, `verify` runs them again.
"""
