"""What is done without sensors, with finished runs and with files: the library's side of the verbs for it.

`optimize` estimates a run again in batch, `join_sessions` several at once, `optimize_graph` a pose-graph file;
`rebuild` makes maps again, `loop_undo` takes loops out, `loop_evaluation` judges them, `train_vocabulary` makes their
words.
"""
