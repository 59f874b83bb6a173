function subscribe(endpoint, changes)
% Print each change of the contact mode, without softfinger.
%
%   pip install pyzmq msgpack             % in a Python version that MATLAB supports
%   pyenv(Version="/that/python", ExecutionMode="OutOfProcess")
%   subscribe                             % tcp://127.0.0.1:5555, forever
%   subscribe("tcp://127.0.0.1:5555", 4)  % four changes
%
% Out of process: MATLAB may load its ZeroMQ instead of the one of pyzmq.
arguments
    endpoint (1, 1) string = "tcp://127.0.0.1:5555"
    changes (1, 1) double = Inf
end
modes = ["free", "rolling", "sliding"];

context = py.zmq.Context();
socket = context.socket(py.zmq.SUB);
done = onCleanup(@() socket.close());
socket.setsockopt(py.zmq.RCVTIMEO, int32(5000)); % error after 5 s without a message
socket.connect(endpoint);
socket.subscribe("contact");

mode = -1;
while changes > 0
    frames = cell(socket.recv_multipart());
    message = struct(py.msgpack.unpackb(frames{2}));
    contact = struct(message.contact);
    if double(contact.mode) == mode
        continue
    end
    mode = double(contact.mode);
    force = round(1e3 * cellfun(@double, cell(message.force))) / 1e3 + 0; % without -0.000
    fprintf("%d %s %.3f %.3f %.3f\n", int64(message.tick), modes(mode + 1), force);
    changes = changes - 1;
end
end
