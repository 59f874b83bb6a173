% Print each change of the contact mode in GNU Octave: octave-cli subscribe_octave.m [ENDPOINT [CHANGES]]
%
%   sudo apt install octave octave-zeromq   % Debian; elsewhere: pkg install -forge zeromq
%
% It uses the topic `state`, 200 messages per second: Octave is too slow to unpack 1000.
1; % a script with functions

function [value, at] = unpack(bytes, at)
  % Return the msgpack value at index `at` of a vector of uint8, and the index after it.
  head = double(bytes(at++));
  number = @(size, kind) double(swapbytes(typecast(bytes(at:at + size - 1), kind)));
  if head < 128, value = head; return, end
  if head >= 224, value = head - 256; return, end
  sizes = [0 0 0 0 1 2 4 0 0 0 4 8 1 2 4 8 1 2 4 8 0 0 0 0 0 1 2 4 2 4 2 4]; % after the heads 0xc0 to 0xdf
  kinds = {"uint8", "uint16", "uint32", "uint64", "int8", "int16", "int32", "int64"};
  if head < 144
    [value, at] = map(bytes, at, head - 128);
  elseif head < 160
    [value, at] = list(bytes, at, head - 144);
  elseif head < 192
    value = char(bytes(at:at + head - 161)); at += head - 160;
  else
    size = sizes(head - 191);
    switch head
      case {192, 194, 195}, value = head == 195; % nil, false, true
      case 202, value = number(4, "single"); at += 4;
      case 203, value = number(8, "double"); at += 8;
      case num2cell(204:211), value = number(size, kinds{head - 203}); at += size;
      case {217, 218, 219} % text
        count = number(size, kinds{log2(size) + 1}); at += size;
        value = char(bytes(at:at + count - 1)); at += count;
      case {220, 221}, [value, at] = list(bytes, at + size, number(size, kinds{log2(size) + 1}));
      case {222, 223}, [value, at] = map(bytes, at + size, number(size, kinds{log2(size) + 1}));
      otherwise, error("a msgpack type that softfinger does not send: %d", head);
    end
  end
end

function [value, at] = map(bytes, at, count)
  value = struct();
  for k = 1:count
    [key, at] = unpack(bytes, at);
    [value.(key), at] = unpack(bytes, at);
  end
end

function [value, at] = list(bytes, at, count)
  value = cell(1, count);
  for k = 1:count
    [value{k}, at] = unpack(bytes, at);
  end
end

pkg load zeromq
given = argv();
endpoint = "tcp://127.0.0.1:5555"; changes = Inf;
if numel(given) > 0, endpoint = given{1}; end
if numel(given) > 1, changes = str2double(given{2}); end
modes = {"free", "rolling", "sliding"};

socket = zmq_socket(ZMQ_SUB);
zmq_setsockopt(socket, ZMQ_SUBSCRIBE, "state");
zmq_connect(socket, endpoint);

mode = -1;
while changes > 0
  zmq_recv(socket, 256, 0); % the topic
  message = unpack(uint8(zmq_recv(socket, 4096, 0)), 1);
  if message.field_state.mode != mode
    mode = message.field_state.mode;
    force = round(1e3 * [message.force{:}]) / 1e3 + 0; % without -0.000
    printf("%d %s %.3f %.3f %.3f\n", message.sequence, modes{mode + 1}, force);
    changes--;
  end
end
zmq_close(socket);
