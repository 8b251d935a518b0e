"""What we expect of TorchRL's private names."""

from torchrl.envs import RewardSum, SerialEnv, StepCounter, TransformedEnv

from tasks import make_env
from torchrl_sym._torchrl import serial_workers


def test_workers_of_a_serial_environment():
    def summed():
        return TransformedEnv(make_env("cartpole", num_envs=2, num_threads=1), RewardSum())

    def counted():
        return TransformedEnv(make_env("cartpole", num_envs=2, num_threads=1), StepCounter())

    for started in (False, True):
        env = SerialEnv(3, [summed, summed, counted])
        if started:
            env.start()
        kinds = [type(worker.transform) for worker in serial_workers(env)]
        assert kinds == [RewardSum, StepCounter]
        env.close()
