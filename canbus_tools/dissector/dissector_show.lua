
-- ------------------------------------------------------------------------------------------------- showing

local function show_values(tree, said)
  for i, value in ipairs(said.values) do
    local name = said.format.names[i]
    if type(value) == "string" and buffers[name] then
      tree:add(buffers[name], ByteArray.new(value, true):tvb(name)())
    elseif numbers[name] then
      tree:add(numbers[name], Int64.new(value))
    end
  end
end

local function show_said(tree, said)
  local branch = tree:add(f.text, said.text)
  branch:add(f.message, said.name or said.format.name)
  if said.values and not said.format.text then
    show_values(branch, said)
  end
  if said.unknown then
    branch:add_proto_expert_info(unknown_expert)
  end
end

local function show_item(tree, pinfo, item)
  local branch = tree:add(f.kind, item.kind)
  if item.begins_in ~= pinfo.number then
    branch:add(f.begins_in, item.begins_in):set_generated()
  end
  if item.block then
    local tvb = ByteArray.new(item.block, true):tvb("Message block")
    branch:add(f.length, tvb(0, 1))
    branch:add(f.seq, tvb(1, 1), item.seq)
    if tvb:len() > BLOCK_MIN then
      branch:add(f.content, tvb(D.block.content_at, tvb:len() - BLOCK_MIN))
    end
    branch:add(f.crc, tvb(tvb:len() - 3, 2))
    branch:add(f.repeated, item.repeated or false):set_generated()
  end
  if item.repeated then
    branch:add_proto_expert_info(repeated_expert)
  elseif item.kind == "nak" then
    branch:add_proto_expert_info(nak_expert)
  elseif item.kind == "noise" then
    branch:add_proto_expert_info(noise_expert)
  end
  for _, said in ipairs(item.said) do
    show_said(branch, said)
  end
end

local function show_data(tvb, pinfo, tree, nodeid, direction, items)
  tree:add(f.nodeid, nodeid):set_generated()
  tree:add(f.direction, direction):set_generated()
  if tvb:len() > 0 then
    tree:add(f.payload, tvb())
  end
  local texts = {}
  for _, item in ipairs(items) do
    show_item(tree, pinfo, item)
    for _, said in ipairs(item.said) do
      texts[#texts + 1] = (item.repeated and "(again) " or "") .. said.text
    end
  end
  local ends = ends_in[pinfo.number]
  if ends and ends ~= pinfo.number then
    tree:add(f.ends_in, ends):set_generated()
  end
  local arrow = direction == TO and "to " or "from "
  pinfo.cols.info = arrow .. nodeid .. ": " .. (#texts > 0 and table.concat(texts, "; ") or "part of a block")
end

-- ------------------------------------------------------------------------------------ admin and signal frames

local function format_of(can_id, data)
  for _, known in ipairs(D.frames) do
    local ours = can_id >= known.can_id and can_id < known.can_id + known.ids and #data >= known.size
    if ours and (not known.command or known.command == data:byte(1)) then
      return known
    end
  end
  return nil
end

local function show_frame(tvb, pinfo, tree, known)
  local branch = tree:add(f.kind, known.kind)
  local words, values, at = { known.name }, {}, known.fields_at
  for i, name in ipairs(known.fields) do
    local field, range = D.fields[name], tvb(at, D.fields[name].size)
    if field.kind == "uuid" then
      values[i] = hex(range:raw())
      words[#words + 1] = name .. "=" .. values[i]
    else
      values[i] = range:le_uint()
      local plain = string.format(field.kind == "hex" and "0x%02x" or "%d", values[i])
      words[#words + 1] = name .. "=" .. (field.values and field.values[values[i]] or plain)
    end
    at = at + field.size
  end
  local said = branch:add(f.text, table.concat(words, " "))
  said:add(f.message, known.name)
  said:add(f.direction, known.direction):set_generated()
  said:add(f.extension, known.extension):set_generated()
  said:add(f.meaning, known.sentence):set_generated()
  at = known.fields_at
  for i, name in ipairs(known.fields) do
    said:add(f[name], tvb(at, D.fields[name].size), values[i])
    at = at + D.fields[name].size
  end
  pinfo.cols.info = table.concat(words, " ")
end

-- --------------------------------------------------------------------------------------------- the dissector

-- What this frame completes, worked out when it is seen first.
local function items_of(tvb, pinfo, can_id, nodeid, direction)
  local kept = results[pinfo.number]
  local blind = can_id_of() == nil
  if kept and not (kept.blind and not blind) then
    return kept.items
  end
  local interface = interface_of()
  local bus = of(buses, blind and "unknown" or interface and interface.value or "only", new_bus)
  local data = tvb:len() > 0 and tvb:raw() or ""
  local items = work_out(pinfo, bus, can_id, nodeid, direction, data)
  results[pinfo.number] = { items = items, blind = blind }
  return items
end

function canductor.dissector(tvb, pinfo, root)
  local can_id = pinfo.match -- the number under which the table had this dissector
  local known = format_of(can_id, tvb:len() > 0 and tvb:raw() or "")
  local nodeid = math.floor((can_id - D.first_data_id) / 2)
  local is_data = nodeid >= 1 and nodeid <= D.nodeid_max
  if not known and not is_data then
    return 0
  end
  pinfo.cols.protocol = "CANDUCTOR"
  local tree = root:add(canductor, tvb())
  if known then
    show_frame(tvb, pinfo, tree, known)
  else
    local direction = can_id % 2 == 0 and TO or FROM
    show_data(tvb, pinfo, tree, nodeid, direction, items_of(tvb, pinfo, can_id, nodeid, direction))
  end
  return tvb:len()
end

local by_id = DissectorTable.get("can.id")
for _, known in ipairs(D.frames) do
  for can_id = known.can_id, known.can_id + known.ids - 1 do
    by_id:add(can_id, canductor)
  end
end
for can_id = D.first_data_id + 2, D.first_data_id + 2 * D.nodeid_max + 1 do
  by_id:add(can_id, canductor)
end
